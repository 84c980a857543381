"""Data sets that say where a user was: recordings, tracks and ways."""

import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.inspection.data_set import DataSet, Epochs
from mmwave_env.episodes.deepmimo.census import Census, census
from mmwave_env.episodes.deepmimo.formats import open_scenario
from mmwave_env.episodes.deepmimo.recording import read_deepmimo
from mmwave_env.episodes.deepmimo.scenario import Scenario
from mmwave_env.episodes.deepmimo.way import SIDECAR
from mmwave_env.episodes.traffic import Traffic
from mmwave_env.episodes.waypoints import read_way
from mmwave_env.logs.tum import tum_blocks
from mmwave_env.numerics.arrays import Array

_USERS = 2000  # of a grid that are looked at, evenly chosen


def scenario_data_set(folder: Path) -> DataSet:
    """The data set of a DeepMIMO scenario: a recording, or a grid of users without a track.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.episodes.deepmimo.recording.read_deepmimo`.
    """
    scenario = open_scenario(folder)
    if not (folder / SIDECAR).exists():
        return _grid_data_set(scenario)
    found = _recording_data_set(folder)
    paths = scenario.paths(scenario.epochs(None))
    found.facts |= _census(census(paths))
    return found


def _census(found: Census) -> dict[str, str]:
    """How many paths there are of each kind, and where the strongest anchors are."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in found.paths.items())
    counted = Counter(anchor.kind for anchor in found.anchors)
    anchors = ", ".join(f"{count} {kind}" for kind, count in counted.items())
    unseen = f"; never seen: {', '.join(found.unseen)}" if found.unseen else ""
    return {
        "paths": f"{kinds}; {found.left_out} of them lead to no anchor",
        "anchors found": f"{anchors}{unseen}",
    }


def _grid_data_set(scenario: Scenario) -> DataSet:
    """Some users of a grid, which is never read as a whole."""
    grid = scenario.grid()
    chosen = np.unique(np.linspace(0, len(grid) - 1, min(len(grid), _USERS)).astype(np.int64))
    paths = scenario.paths(np.column_stack([np.zeros_like(chosen), chosen]))
    low, high = grid.min(axis=0), grid.max(axis=0)
    extent = " x ".join(f"{a:.6g} to {b:.6g} m" for a, b in zip(low, high, strict=True))
    return DataSet(
        format="DeepMIMO scenario, users without a track",
        epochs=[_bare(chosen.astype(float), paths.position_m)],
        positions="the scenario",
        timed=False,
        facts={
            "users": f"{len(grid)} in {extent}; {len(chosen)} of them looked at",
            "base stations": str(len(scenario.stations)),
            "carrier": f"{scenario.carrier_hz / 1e9:g} GHz",
            **_census(census(paths)),
        },
        problems=["no times: mmwave-loc record makes a recording of a way through it"],
    )


def _recording_data_set(folder: Path) -> DataSet:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        recording = read_deepmimo(folder)
    links = recording.visible[:, : recording.layout.anchors]
    gains = recording.path_gain_db[links]
    low, high = np.percentile(gains, [5.0, 95.0])
    assert recording.position_m is not None  # of a scenario it is always known
    return DataSet(
        format="DeepMIMO scenario",
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
        ValueError, OSError: as :func:`~mmwave_env.episodes.waypoints.read_way`.
    """
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        way = read_way(path)
    return DataSet(
        format="way, CSV (--scenario takes it)",
        epochs=[_bare(way.time_s, way.position_m)],
        positions="the way",
        problems=[str(one.message) for one in said],
    )


def traffic_data_set(traffic: Traffic) -> DataSet:
    """The data set of a traffic simulation's trips, one after the other.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.episodes.fcd.read_fcd`.
    """
    trips = traffic.trips
    kinds = Counter(trip.kind for trip in trips)
    places = np.concatenate([trip.position_m for trip in trips])
    times = np.concatenate([trip.time_s for trip in trips])
    moved = [np.linalg.norm(np.diff(t.position_m, axis=0), axis=1) / np.diff(t.time_s)
             for t in trips]  # fmt: skip
    speeds = np.concatenate(moved) if any(map(len, moved)) else np.zeros(1)
    longest = max(float(np.ptp(trip.time_s)) for trip in trips)
    return DataSet(
        format="traffic, floating-car data of SUMO (--scenario takes it)",
        epochs=[_bare(np.arange(len(places), dtype=float), np.pad(places, ((0, 0), (0, 1))))],
        positions="the trips, one after the other",
        timed=False,
        facts={
            "trips": f"{len(trips)}: {', '.join(f'{n} {kind}' for kind, n in kinds.items())}",
            "time": f"{times.min():.6g} to {times.max():.6g} s; the longest trip {longest:.6g} s",
            "speed": f"{np.median(speeds):.2f} m/s at 50 %, {np.quantile(speeds, 0.95):.2f} m/s "
                     f"at 95 %, {speeds.max():.2f} m/s at most",
        },
    )  # fmt: skip
