"""Recordings as DeepMIMO v4 folders, for other people's tools and for our own reader.

A link to a virtual anchor at a is written as what it is in the street: a path that bounces once.
The wall is the plane halfway between the base station at g and its image a, and the bounce is
where the straight line from a to the user at p goes through it (paper, Sec. II):

    q = a + s (p - a),    s = |g - a|^2 / (2 (g - a) . (p - a))

Delay and arrival are those of the straight line; the departure points from g to q. Phases are
those of the reflections alone, as in Sionna's: 180 degrees, and 0 of a line of sight.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mmwave_env import __version__
from mmwave_env.episodes.checks import refuse
from mmwave_env.episodes.deepmimo.paths import LINE_OF_SIGHT, REFLECTION, Paths, StationPaths
from mmwave_env.episodes.deepmimo.v4_writer import write_v4
from mmwave_env.episodes.recorded import Recording
from mmwave_env.episodes.trajectory import Trajectory
from mmwave_env.models.measurement import LINK, SPEED_OF_LIGHT, direction
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.numbers import PI, wrap

_TOLERANCES = (0.1, 0.02, 0.02, 0.02)  # m, rad: rows further off contradict the positions


def write_deepmimo(
    folder: str | os.PathLike[str], recording: Recording, stations: bool = False
) -> list[str]:
    """Write a recording as a static scenario whose receivers are its epochs.

    All of it is exact geometry, without a receiver's noise. There are no buildings in it, as a
    recording knows none. :mod:`~mmwave_env.episodes.deepmimo.recording` reads it back: anchors
    then come in the order of how often they are seen, and one that is never seen does not come;
    without a line of sight to the base station at any epoch, nothing is read.

    Args:
        folder: made where it is not there.
        recording: with its truth.
        stations: whether every anchor is a base station, a transmitter of the scenario; else the
            first is one and the others are its mirror images.

    Returns:
        The names of the files.

    Raises:
        ValueError: nobody knows where the user was, or it is no way of a user; a link contradicts
            where user and anchor are; an anchor can't be an image, because the user is behind its
            wall; or arrays of another scenario lie in the folder.
        OSError: a file can't be written.
    """
    paths, velocity = paths_of(recording, stations)
    record = f"recording {recording.name!r}"
    Trajectory(record, recording.time_s, paths.position_m, velocity)  # refuses what none reads back
    rays = {
        "raytracer_version": __version__,
        "ray_casting_method": "mirror images",
        "raw_params": {"bandwidth": recording.bandwidth_hz},
    }
    return write_v4(Path(folder), paths, recording.time_s, velocity, rays)


def paths_of(recording: Recording, stations: bool = False) -> tuple[Paths, Array]:
    """The paths that a recording's links are, and the velocities (T, 3) of its user.

    Arguments and errors as of :func:`write_deepmimo`.
    """
    position, velocity = _truth(recording)
    anchors = range(recording.layout.anchors)
    members = [[k] for k in anchors] if stations else [list(anchors)]
    links = tuple(_paths(recording, position, each) for each in members)
    return Paths(recording.name, recording.carrier_hz, position, links), velocity


def _truth(recording: Recording) -> tuple[Array, Array]:
    """Positions and velocities (T, 3) of a recording, whose links do not contradict them."""
    record = f"recording {recording.name!r}"
    position, velocity = recording.position_m, recording.velocity_mps
    if position is None or velocity is None:
        refuse(record, "position_m, velocity_mps", "none", "where the user was")
    offset = position[:, None] - recording.anchors_m
    distance, azimuth, elevation = direction(list(np.moveaxis(offset, -1, 0)))
    exact = np.stack([distance, azimuth, elevation, wrap(azimuth + PI)], axis=-1)
    T, L = distance.shape
    error = recording.measurement[:, : 4 * L].reshape(T, L, 4) - exact
    error[..., 1:] = wrap(error[..., 1:])
    error[..., [1, 3]] *= np.cos(elevation)[..., None]  # at the zenith azimuths mean nothing
    wrong = recording.visible[:, :L, None] & ~(np.abs(error) <= _TOLERANCES)
    if wrong.any():
        t, k, row = (int(i) for i in np.argwhere(wrong)[0])
        found = recording.measurement[t, 4 * k + row]
        refuse(record, f"{LINK[row]} of anchor {k + 1} at {recording.time_s[t]:g} s",
               f"{found:.4f}", f"{exact[t, k, row]:.4f}, as the positions say")  # fmt: skip
    return position, velocity


def _paths(recording: Recording, position_m: Array, anchors: Sequence[int]) -> StationPaths:
    """The paths of a base station: the first of these anchors, the others are its images."""
    seen, images = recording.visible[:, anchors], recording.anchors_m[anchors]
    # Paths that are there come first, as the format has them.
    order = np.argsort(~seen, axis=1, kind="stable")[:, : max(1, seen.sum(axis=1).max())]
    bounce = _bounces(recording, position_m, anchors)
    position = position_m[:, None]
    arrival = images - position
    departure = np.where(np.isfinite(bounce), bounce, position) - images[0]

    def packed(values: Array) -> Array:
        at = order.reshape(order.shape + (1,) * (values.ndim - 2))
        there = np.where(seen.reshape(seen.shape + (1,) * (values.ndim - 2)), values, np.nan)
        return np.take_along_axis(there, at, axis=1)

    reflected = np.broadcast_to(np.arange(len(anchors)) > 0, seen.shape)
    return StationPaths(
        name=f"anchor {anchors[0] + 1}",
        position_m=images[0],
        interactions=packed(np.where(reflected, REFLECTION, LINE_OF_SIGHT)),
        bounce_m=packed(bounce),
        gain_db=packed(recording.path_gain_db[:, anchors]),
        delay_s=packed(np.linalg.norm(arrival, axis=-1) / SPEED_OF_LIGHT),
        arrival=packed(_angles(arrival)),
        departure=packed(_angles(departure)),
        source=lambda key, epoch: (Path(recording.name), epoch),
        phase_rad=packed(np.where(reflected, PI, 0.0)),
    )


def _bounces(recording: Recording, position_m: Array, anchors: Sequence[int]) -> Array:
    """Where paths bounce (T, K, 3); NaN for lines of sight, and where there is no path."""
    gnb = recording.anchors_m[anchors[0]]
    bounce = np.full((len(recording), len(anchors), 3), np.nan)
    for k, anchor in enumerate(anchors[1:], start=1):
        seen, image = recording.visible[:, anchor], recording.anchors_m[anchor]
        normal, away = gnb - image, position_m[seen] - image
        # In front of the wall, users are further from the image than from the base station.
        in_front = 2.0 * away @ normal > normal @ normal
        if not in_front.all():
            t = int(np.flatnonzero(seen)[np.argmin(in_front)])
            refuse(
                f"recording {recording.name!r}", f"anchor {anchor + 1} at {image.tolist()}",
                f"the user at {recording.time_s[t]:g} s as near to it as to the base station",
                "a mirror image, which is further; stations=True writes anchors as base stations",
            )  # fmt: skip
        bounce[seen, k] = image + away * (normal @ normal / (2.0 * away @ normal))[:, None]
    return bounce


def _angles(way: Array) -> Array:
    """Azimuths and zenith angles (T, K, 2) of directions (T, K, 3), rad."""
    x, y, z = np.moveaxis(way, -1, 0)
    return np.stack([np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)], axis=-1)
