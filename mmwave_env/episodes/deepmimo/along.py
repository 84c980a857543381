"""A recording from a grid of users: what those along a way would have measured.

The static scenarios of DeepMIMO are grids, such as the 1.2 million users of O1. A user who goes
along a way is at each epoch the nearest of them; or a place between the four nearest, whose links
are weighted means of theirs. Only the paths of users along the way are read.
"""

import os
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mmwave_env.episodes.deepmimo.formats import open_scenario
from mmwave_env.episodes.deepmimo.grid import Sampling, nearest_users, surrounding_users
from mmwave_env.episodes.deepmimo.recording import recording_of
from mmwave_env.episodes.recorded import Recording
from mmwave_env.episodes.trajectory import Trajectory
from mmwave_env.models.measurement import range_rate, wrap_angles
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.numbers import wrap

_COUNTS = 1e-6  # the least weight of a user who is looked at
_MOST_EPOCHS = 1_000_000


class Sampled(NamedTuple):
    """A recording from a grid.

    Attributes:
        recording: whose true positions are those that were measured at.
        users: how many users of the grid are in it.
        error_m: (E,) from the way to these positions.
    """

    recording: Recording
    users: int
    error_m: Array


def record_along(
    folder: str | os.PathLike[str],
    way: Trajectory,
    dt_s: float = 0.1,
    interpolate: bool = False,
    within_m: float = 1.0,
    virtual_anchors: int = 2,
    ground: bool = False,
    bandwidth_hz: float = 100e6,
    *,
    base_station: int | None = None,
    receiver_set: int | None = None,
) -> Sampled:
    """The recording of a user who goes along a way through a grid.

    Truth is exact with either kind of users: it is where they stand, not the way, and
    ``error_m`` says how far that is from it. Velocities are the way's. Between users, a link is
    there if all of them have it; its rows and its gain are linear in x and y.

    Args:
        folder: of a static scenario.
        way: in the frame of the scenario.
        dt_s: seconds between epochs.
        interpolate: between the four nearest users; else the nearest.
        within_m: how far the nearest user may be from the way.
        virtual_anchors, ground, bandwidth_hz, base_station, receiver_set: as of
            :func:`~mmwave_env.episodes.deepmimo.recording.read_deepmimo`.

    Raises:
        FileNotFoundError, ValueError: as there; or the way leaves the grid, or is none of two to a
            million epochs.
    """
    last_s = float(np.ptp(way.time_s))
    if not last_s / _MOST_EPOCHS < dt_s <= last_s:
        raise ValueError(
            f"dt_s: found {dt_s}, expected seconds between epochs, at most {last_s:g}, as long as "
            f"{way.name} takes, and two to a million epochs"
        )
    if not within_m >= 0.0:
        raise ValueError(f"within_m: found {within_m}, expected at least 0")
    scenario = open_scenario(Path(folder), receiver_set)
    if scenario.is_dynamic:
        raise ValueError(f"{folder}: found {len(scenario.scenes)} scenes, expected a grid of users "
                         "in one: name a user of a dynamic scenario instead")  # fmt: skip
    wanted = way.resampled(dt_s)
    time = way.time_s[0] + dt_s * np.arange(len(wanted))
    sampling = (surrounding_users if interpolate else nearest_users)(scenario.grid(), wanted[:, :3])
    far = sampling.nearest_m > within_m
    if far.any():
        e = int(np.argmax(far))
        raise ValueError(
            f"{way.name}: found {np.round(wanted[e, :3], 3).tolist()} at {time[e]:g} s, expected a "
            f"place within {within_m:g} m of a user of {folder}; the nearest is "
            f"{sampling.nearest_m[e]:.3g} m away"
        )
    users, place = np.unique(sampling.users, return_inverse=True)
    paths = scenario.paths(scenario.epochs(users), base_station)
    each = recording_of(
        paths, np.arange(len(users), dtype=float), np.zeros((len(users), 3)),
        virtual_anchors, ground, bandwidth_hz,
    )  # fmt: skip
    sampling = sampling._replace(users=place.reshape(sampling.users.shape))
    recording = _weighted(each, sampling, time, wanted[:, 3:])
    error = np.linalg.norm(sampling.position_m - wanted[:, :3], axis=1)
    return Sampled(recording, len(users), error)


def _weighted(each: Recording, sampling: Sampling, time_s: Array, velocity_mps: Array) -> Recording:
    """The recording of weighted users, from one with a row for every user."""
    users, weight, layout = sampling.users, sampling.weights[..., None], each.layout
    visible = np.all(each.visible[users] | (np.abs(weight) < _COUNTS), axis=1)
    rows, gain = each.measurement[users], each.path_gain_db[users]
    change = rows - rows[:, :1]
    change[..., layout.angles] = wrap(change[..., layout.angles])
    measurement = rows[:, 0] + np.sum(np.where(np.isfinite(change), weight * change, 0.0), axis=1)
    wrap_angles(measurement, layout)
    away = list((sampling.position_m - each.anchors_m[0]).T)
    shift = each.scene.hz_per_mps * range_rate(away, list(velocity_mps.T))
    measurement[:, layout.doppler] = shift
    return replace(
        each,
        time_s=time_s,
        measurement=measurement,
        visible=visible,
        path_gain_db=np.sum(np.where(np.isfinite(gain), weight * gain, 0.0), axis=1),
        position_m=sampling.position_m,
        velocity_mps=velocity_mps,
    )
