"""Sources of episodes, made from the samples that the package contains or from a user's data."""

import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from mmwave_env.datasets.deepmimo.recording import read_deepmimo
from mmwave_env.datasets.deepmimo.v4 import PARAMS
from mmwave_env.datasets.log_folder import read_log_folder
from mmwave_env.datasets.recorded import MeasuredTrack, Recording, Track, TrackSource
from mmwave_env.io.files import AnyPath
from mmwave_env.io.lookup import choose
from mmwave_env.models.radio import Radio

_DATA = Path(str(resources.files("mmwave_env"))) / "data"
_KINDS = {"log": _DATA / "logs", "recording": _DATA / "deepmimo_canyon28"}


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


def recording_from(name: str) -> Recording:
    """Read the recording with this name, one of :func:`sample_names`."""
    return read_deepmimo(sample_folder(name, "recording"))


def source_from(
    episodes: AnyPath | Recording | MeasuredTrack,
    radio: str | Radio,
    epochs: int | None = None,
    measurements: Sequence[str] | None = None,
    clock: str = "synchronized",
) -> TrackSource:
    """Return the source of episodes for an argument ``episodes=`` or an option ``--data``.

    Args:
        episodes: one of :func:`sample_names`; a folder with a measurement log, its scene and its
            true track, or with a DeepMIMO v4 scenario; a recording; or a measured track.
        radio, epochs, measurements, clock: same as in :class:`TrackSource`.

    Raises:
        ValueError: the name is unknown, the folder contains something else, or the data are
            shorter than ``epochs``.
        OSError: a file can't be read.
    """
    track = _read(episodes, clock) if isinstance(episodes, str | os.PathLike) else episodes
    return TrackSource(track, radio, epochs, measurements, clock)


def _read(episodes: AnyPath, clock: str) -> Track:
    """Read the sample with this name, or the folder with this path."""
    if episodes in sample_names():
        return recording_from(str(episodes))
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
