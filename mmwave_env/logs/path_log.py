"""Logs of paths: one row per epoch and path, as a receiver finds them, with no anchor number.

The columns are those of a log (`log.py`) without ``anchor``. The rows of an epoch are in any
order and may include false paths. Every path may have a Doppler shift, because the base
station's path is not known yet.
"""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log_checks import whole_epochs
from mmwave_env.logs.log_columns import STATION
from mmwave_env.logs.log_tables import LogError, Table, open_log
from mmwave_env.models.measurement import Layout, wrapped
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array


class PathEpoch(NamedTuple):
    """The n paths of an epoch; all numbers were measured, except perhaps the Doppler shift."""

    layout: Layout  # layout of the scene's anchors, with or without odometry
    time_s: float
    measurement: Array  # (n, 5) rows of a link, m and rad, and its Doppler shift, Hz, or NaN
    at_station: bool  # whether arrivals were seen at the base station, not at its mirror image
    snr_db: Array  # (n,)
    incomplete: int  # number of paths that are left out because some of their numbers are missing
    doppler_spread_hz: float  # 0 where none was measured
    odometry: Array  # (2,) speed, m/s, and heading, rad; NaN where not measured
    share: float  # share of the file read so far, 0 to 1


def read_paths(path: Path, scene: Scene, odometry: bool = True) -> Iterator[PathEpoch]:
    """Read the epochs of a log of paths, one after the other.

    A column of anchors is ignored, so that a log with labels can be read as one without.

    Args:
        path, scene, odometry: as :func:`~mmwave_env.logs.log.read_log` takes them.

    Raises:
        LogError: as :func:`~mmwave_env.logs.log.read_log`; also for too many paths in an epoch.
        OSError: the file can't be read.
    """
    log = open_log(path, scene.hz_per_mps, odometry, associated=False)
    layout, measured, epochs = Layout(len(scene.anchors_m), "speed" in log.columns), False, 0
    for table in whole_epochs(log, None, limits=True):
        for epoch in _split(table, layout):
            measured, epochs = measured or len(epoch.snr_db) > 0, epochs + 1
            yield epoch
    if not measured:
        raise LogError(f"{path}: found {epochs} epochs without a whole path, expected at least one")


def _split(table: Table, layout: Layout) -> Iterator[PathEpoch]:
    """Yield the paths of every epoch, without incomplete ones."""
    snr, time = table["snr"], table["time"]
    measurement = np.column_stack([table.links(), table["doppler"]])
    measurement[:, 1:4] = wrapped(measurement[:, 1:4])
    finite = np.isfinite(np.column_stack([measurement[:, :4], snr]))
    whole, some = finite.all(axis=1), finite.any(axis=1)
    spread, speed, heading = (
        table.first(table[quantity]) for quantity in ("doppler_spread", "speed", "heading")
    )
    odometry = np.column_stack([speed, wrapped(heading)])
    ends = np.searchsorted(table.epoch, np.arange(len(spread)), side="right")
    for epoch, (first, end) in enumerate(pairwise([0, *ends.tolist()])):
        kept = np.flatnonzero(whole[first:end]) + first
        yield PathEpoch(
            layout=layout,
            time_s=float(time[first]),
            measurement=measurement[kept],
            at_station=STATION in table.columns,
            snr_db=snr[kept],
            incomplete=int((some & ~whole)[first:end].sum()),
            doppler_spread_hz=float(np.nan_to_num(spread[epoch])),
            odometry=odometry[epoch],
            share=table.share,
        )
