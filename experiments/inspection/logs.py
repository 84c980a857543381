"""Measurement logs as data sets."""

import warnings
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path

import numpy as np

from experiments.inspection.data_set import DataSet, Epochs
from mmwave_env.episodes.arrays import warn_of_contradictions
from mmwave_env.localization.contradictions import contradictions
from mmwave_env.logs.clock import ClockComparison
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.logs.path_log import read_paths
from mmwave_env.logs.truth import Truth
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import Scene, scene_from
from mmwave_env.numerics.arrays import Array


def log_data_set(path: Path, scene: str, truth: Path | None, radio: str) -> DataSet:
    """The data set of a log.

    Args:
        path: of the log.
        scene: its name, or its file.
        truth: its file, if there is one.
        radio: profile of the receiver, by which the Doppler shift is held beside the range.

    Raises:
        ValueError: one of the files is not what it should be, from its beginning on.
        OSError: a file can't be read.
    """
    there, given = scene_from(scene), Truth(truth) if truth else None
    blocks, clocks = read_log(path, there), ClockComparison(there)
    first = next(blocks)

    def epochs() -> Iterator[Epochs]:
        incomplete = np.zeros(len(first.layout.groups), np.int64)
        try:
            for block in chain([first], blocks):
                incomplete += block.incomplete.sum(axis=0)
                position = _fixes(block, there)
                if given:
                    true = given.at(block.time_s)
                    position = true.position_m
                    clocks.add(block, true)
                if block is first:
                    said = "links" if given else "links, the fixes taken for the truth"
                    found.problems += _misplaced(said, block, there, position)
                yield Epochs(block.time_s, position, block.visible[:, : block.layout.anchors])
        except LogError as damage:
            found.damage = damage
        clock = clocks.offset(truth)
        if clock and clock.matters:
            found.problems.append(clock.advice)
        found.problems += [
            f"{count} times only some of the numbers of {name}, which count as not measured"
            for name, count in zip(first.layout.group_names, incomplete, strict=True)
            if count
        ]

    found = DataSet(
        format=f"measurement log, {'Parquet' if path.suffix == '.parquet' else 'CSV'}",
        epochs=epochs(),
        positions=f"truth, {truth}" if truth else "fixes by range and angles of anchor 1",
        are_true=truth is not None,
        anchors_m=there.anchors_m,
        facts=_facts(first, there),
        problems=list(map(str, contradictions(first, there, radio_from(radio), {}))),
    )
    return found


_TOGETHER = 1000  # epochs of a log of paths that are summed up at once


def paths_data_set(path: Path, scene: str, truth: Path | None) -> DataSet:
    """The data set of a log without the numbers of anchors; arguments as of :func:`log_data_set`.

    Raises:
        ValueError, OSError: as :func:`log_data_set`.
    """
    there, given = scene_from(scene), Truth(truth) if truth else None

    def epochs() -> Iterator[Epochs]:
        paths = incomplete = 0
        try:
            rows = read_paths(path, there)
            while some := list(islice(rows, _TOGETHER)):
                paths += sum(len(epoch.snr_db) for epoch in some)
                incomplete += sum(epoch.incomplete for epoch in some)
                time_s, n = np.array([epoch.time_s for epoch in some]), len(some)
                position = given.at(time_s).position_m if given else np.full((n, 3), np.nan)
                yield Epochs(time_s, position, np.zeros((n, 0), bool))
        except LogError as damage:
            found.damage = damage
        found.facts["paths"] = f"{paths}, and {incomplete} with only some of their numbers"

    found = DataSet(
        format="measurement log of paths without anchors (localize --associate)",
        epochs=epochs(),
        positions=f"truth, {truth}" if truth else "none",
        are_true=truth is not None,
        facts={"scene": f"{there.name}, {len(there.anchors_m)} anchors"},
    )
    return found


def _misplaced(what: str, block: LogBlock, scene: Scene, position_m: Array) -> list[str]:
    """What positions (T, 3) say about the links of a block."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        warn_of_contradictions(
            what, scene, block.layout, block.measurement, block.visible, position_m
        )
    return [str(one.message) for one in said]


def _facts(block: LogBlock, scene: Scene) -> dict[str, str]:
    seen = np.isfinite(block.snr_db)
    low, high = np.percentile(block.snr_db[seen], [5.0, 95.0]) if seen.any() else (np.nan, np.nan)
    return {
        "scene": f"{scene.name}, {scene.carrier_hz / 1e9:g} GHz, "
                 f"{scene.bandwidth_hz / 1e6:g} MHz wide",
        "SNR": f"{low:.1f} to {high:.1f} dB in 9 of 10 links of the first {len(block)} epochs",
        "odometry": "yes" if block.layout.odometry else "no",
    }  # fmt: skip


def _fixes(block: LogBlock, scene: Scene) -> Array:
    """Positions (T, 3) where the base station's link says the user is; NaN without one."""
    distance, azimuth, elevation = block.measurement[:, :3].T
    level = distance * np.cos(elevation)
    away = [level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)]
    fixes = scene.anchors_m[0] + np.column_stack(away)
    return np.where(block.visible[:, :1], fixes, np.nan)
