"""Reader and writer of folders with the log, the scene and the true track of an episode."""

import warnings
from pathlib import Path

import numpy as np

from mmwave_env.datasets.deepmimo.v4 import PARAMS
from mmwave_env.datasets.log_writer import log_columns, log_text
from mmwave_env.datasets.measured import MeasuredTrack
from mmwave_env.io.files import write_json, write_text
from mmwave_env.io.lookup import as_name
from mmwave_env.logs.clock import clock_offset
from mmwave_env.logs.log import read_log
from mmwave_env.logs.log_tables import SUFFIXES
from mmwave_env.logs.truth import Truth, velocity_of
from mmwave_env.logs.tum import COLUMNS, tum_lines
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene, read_scene, scene_json
from mmwave_env.world.episode import Episode

LOG = "log.csv"
SCENE = "scene.json"
TRUTH = "truth.tum"
_LOGS = tuple(f"log{suffix}" for suffix in SUFFIXES)


def read_log_folder(folder: Path, clock: bool = False) -> MeasuredTrack:
    """Read a folder with a log, its scene and its true track, completely into memory.

    :class:`~mmwave_env.logs.truth.Truth` interpolates the true positions at the times of the
    epochs. True velocities are computed from these positions. The layout is partial (single values
    of a link may be missing) if a link lacks some of its values, if the log states standard
    deviations, or if a Doppler shift was measured at an anchor other than the base station. If the
    clocks of log and track seem to differ, there is a warning.

    Args:
        folder: contains ``log.csv`` (or ``.csv.gz``, ``.parquet``), ``scene.json``, ``truth.tum``.
        clock: whether ranges contain an unknown offset of the user's clock.

    Raises:
        ValueError: a file is missing, damaged or of a wrong kind, or no epoch has a known true
            position; the message names file and row, what was found and what was expected.
        OSError: a file can't be read.
    """
    path = log_of(folder)
    scene = read_scene(folder / SCENE)
    truth = Truth(folder / TRUTH)
    log = read_log(path, scene, partial=True, clock=clock)
    if log.damage:
        raise log.damage
    whole = log.whole()
    if np.array_equal(whole.visible, log.visible) and not np.isfinite(log.sigma).any():
        log = whole
    true = truth.at(log.time_s)
    ends = float(log.time_s[0]), float(log.time_s[-1])
    matched = int(np.isfinite(true.position_m[:, 0]).sum())
    if not matched:
        raise truth.no_match(*ends)
    truth.warn_if_few(matched, len(log), *ends)
    ahead = clock_offset(log, scene, truth.at)
    if ahead and ahead.matters:
        warnings.warn(f"{truth.path}: {ahead.advice}", stacklevel=2)
    return MeasuredTrack(
        name=as_name(folder.resolve().name),
        scene=scene,
        layout=log.layout,
        time_s=log.time_s,
        measurement=log.measurement,
        visible=log.visible,
        snr_db=log.snr_db,
        doppler_spread_hz=log.doppler_spread_hz,
        sigma=log.sigma if log.layout.partial else None,
        doppler_anchor=log.doppler_anchor if log.layout.partial else None,
        position_m=true.position_m,
        velocity_mps=velocity_of(log.time_s, true.position_m, GAP_S),
    )


def log_of(folder: Path) -> Path:
    """Return the log of a folder; refuse a folder that lacks a file or has several logs."""
    logs = [name for name in _LOGS if (folder / name).exists()]
    missing = [] if logs else [LOG]
    missing += [name for name in (SCENE, TRUTH) if not (folder / name).exists()]
    if missing or len(logs) > 1:
        files = f"no {', no '.join(missing)}" if missing else " and ".join(logs)
        raise ValueError(
            f"{folder}: found {files}, expected a log (one of {', '.join(_LOGS)}), {SCENE} and "
            f"{TRUTH} (docs/own-log.md), or the {PARAMS} of a DeepMIMO scenario"
        )
    return folder / logs[0]


def write_log_folder(folder: Path, episode: Episode, scene: Scene, origin: str) -> list[str]:
    """Write an episode so that :func:`read_log_folder` can read it; return the names of the files.

    Args:
        folder: folder to write to; created if it does not exist.
        episode: the episode, whose prior is not written. If its true positions are unknown, an
            existing ``truth.tum`` is removed, because it does not belong to the new log.
        scene: scene of the episode.
        origin: how the episode was made, as text for a comment in ``truth.tum``.

    Raises:
        OSError: a file can't be written.
    """
    write_text(folder / LOG, log_text(log_columns(episode)))
    write_json(folder / SCENE, scene_json(scene))
    if episode.truth_position_m is None:
        (folder / TRUTH).unlink(missing_ok=True)
        return [LOG, SCENE]
    track = tum_lines(episode.time_s, episode.truth_position_m)
    write_text(folder / TRUTH, f"# {' '.join(COLUMNS)}; {origin}\n{track}")
    return [LOG, SCENE, TRUTH]
