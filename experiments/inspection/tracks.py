"""Data sets that say where a user was: recordings, tracks and ways."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.inspection.data_set import DataSet, Epochs
from mmwave_env.episodes.deepmimo.recording import read_deepmimo
from mmwave_env.episodes.trajectory import read_trajectory
from mmwave_env.logs.tum import tum_blocks
from mmwave_env.numerics.arrays import Array


def recording_data_set(folder: Path) -> DataSet:
    """The data set of a DeepMIMO scenario.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.episodes.deepmimo.recording.read_deepmimo`.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        recording = read_deepmimo(folder)
    links = recording.visible[:, : recording.layout.anchors]
    gains = recording.path_gain_db[links]
    low, high = np.percentile(gains, [5.0, 95.0])
    assert recording.position_m is not None  # of a scenario it is always known
    return DataSet(
        format="DeepMIMO v4 scenario",
        epochs=[Epochs(recording.time_s, recording.position_m, links)],
        positions="the scenario",
        anchors_m=recording.anchors_m,
        facts={
            "carrier": f"{recording.carrier_hz / 1e9:g} GHz",
            "path gains": f"{low:.1f} to {high:.1f} dB in 9 of 10 links",
        },
        problems=[str(one.message) for one in said],
    )


def _bare(time_s: Array, position_m: Array) -> Epochs:
    """Epochs of which there are no links."""
    return Epochs(time_s, position_m, np.zeros((len(time_s), 0), bool))


def tum_data_set(path: Path) -> DataSet:
    """The data set of a track in TUM format.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.logs.tum.tum_blocks`.
    """
    blocks = tum_blocks(path)
    first = next(blocks)

    def epochs() -> Iterator[Epochs]:
        yield _bare(*first)
        try:
            for poses in blocks:
                yield _bare(*poses)
        except ValueError as damage:
            found.damage = damage

    found = DataSet(format="track, TUM", epochs=epochs(), positions="the track")
    return found


def way_data_set(path: Path) -> DataSet:
    """The data set of a way that somebody went.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.episodes.trajectory.read_trajectory`.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        way = read_trajectory(path)
    return DataSet(
        format="way, CSV (--scenario takes it)",
        epochs=[_bare(way.time_s, way.position_m)],
        positions="the way",
        problems=[str(one.message) for one in said],
    )
