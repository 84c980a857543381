"""Recordings by name: those that come with the package, and folders of one's own."""

import os
from importlib import resources
from pathlib import Path

from mmwave_env.episodes.deepmimo import read_deepmimo
from mmwave_env.episodes.recorded import Recording


def _samples() -> Path:
    return Path(str(resources.files("mmwave_env"))) / "data" / "deepmimo_canyon28"


def sample_names() -> tuple[str, ...]:
    """Names of the recordings that come with the package, for :func:`recording_from`."""
    return tuple(sorted(folder.name for folder in _samples().iterdir() if folder.is_dir()))


def recording_from(name: str | os.PathLike[str]) -> Recording:
    """The recording of a name in :func:`sample_names`, or of a DeepMIMO v4 scenario's folder.

    Raises:
        ValueError: neither; or a folder that does not hold a scenario, naming the file.
        FileNotFoundError: a file of the scenario is missing.
    """
    names = sample_names()
    folder = _samples() / name if name in names else Path(name)
    if not folder.is_dir():
        raise ValueError(
            f"recording: found {os.fspath(name)!r}, expected one of {', '.join(names)}, or the "
            "folder of a DeepMIMO v4 scenario"
        )
    return read_deepmimo(folder)
