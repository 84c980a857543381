"""Recorded tracks: the samples that the package contains, and a user's data."""

from pathlib import Path

from mmwave_env.datasets.deepmimo.recording import read_deepmimo
from mmwave_env.datasets.deepmimo.v4 import PARAMS
from mmwave_env.datasets.log_folder import read_log_folder
from mmwave_env.datasets.recorded import Track
from mmwave_env.io.files import DATA, AnyPath
from mmwave_env.io.lookup import choose

_KINDS = {"log": DATA / "logs", "recording": DATA / "deepmimo_canyon28"}


def sample_names(kind: str = "recording") -> tuple[str, ...]:
    """Return the names of the samples in the package, whose kind is ``log`` or ``recording``."""
    folders = choose(_KINDS, kind, "kind").iterdir()
    return tuple(sorted(folder.name for folder in folders if folder.is_dir()))


def sample_folder(name: str, kind: str = "log") -> Path:
    """Return the folder of a sample.

    Raises:
        ValueError: there is no such sample; the message lists the names.
    """
    choose(dict.fromkeys(sample_names(kind)), name, "sample")
    return _KINDS[kind] / name


def read_track(episodes: AnyPath, clock: str = "synchronized") -> Track:
    """Read the data that an argument ``episodes=`` or an option ``--data`` names.

    Args:
        episodes: one of :func:`sample_names`; or a folder with a measurement log, its scene and its
            true track, or with a DeepMIMO v4 scenario.
        clock: the clock of a log, as in :class:`~mmwave_env.datasets.recorded.TrackSource`.

    Raises:
        ValueError: the name is unknown, or the folder contains something else.
        OSError: a file can't be read.
    """
    if episodes in sample_names():
        return read_deepmimo(sample_folder(str(episodes), "recording"))
    folder = Path(episodes)
    if not folder.is_dir():
        raise ValueError(
            f"episodes: found {str(folder)!r}, expected one of {', '.join(sample_names())}, "
            "or a folder with a measurement log, its scene and its truth, or a DeepMIMO scenario "
            "(a file with a trajectory belongs to --scenario)"
        )
    if (folder / PARAMS).exists():
        return read_deepmimo(folder)
    return read_log_folder(folder, clock)
