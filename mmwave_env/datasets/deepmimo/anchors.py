"""Assignment of ray-traced paths to anchors: a base station and its mirror images.

The line of sight is the link to the station, which is at g. If a path bounces once, at q, the
receiver at p sees the signal come from the station's mirror image, at a (paper, Sec. II):

    a = q + |g - q| (q - p) / |q - p|

A flat wall gives all receivers the same image, so images that coincide are one virtual anchor. The
range and the angles of arrival of a reflected path are those of the straight line from the image.
In the files, departures are directions at the station, before the bounce, and must be mirrored.

Other paths (two bounces, diffraction, scattering, transmission) are left out: they have no fixed
image, or their image can't be computed from their first point of interaction.

Paths are passed as :class:`StationPaths`, whatever the file format. Values have the same meaning
as in the files, but angles are in radians.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from mmwave_env.models.layout import LINK
from mmwave_env.models.measurement import SPEED_OF_LIGHT, direction
from mmwave_env.numerics.numbers import PI, Array, Index, Mask, wrap

TOLERANCE_M = 0.05  # points this close count as equal; rounding to float32 moves points by 1e-4 m
# ``interactions`` has one digit for each interaction on a path; 0 means no interaction.
LINE_OF_SIGHT = 0.0
REFLECTION = 1.0


class StationPaths(NamedTuple):
    """The n lines of sight and single reflections between one base station and E receivers.

    All values are finite, except ``bounce_m`` of a line of sight. Other paths are left out.
    """

    position_m: Array  # (3,) position of the station
    epoch: Index  # (n,) the receiver's epoch, from 0 to E - 1
    path: Index  # (n,) number of the path among those of its receiver in the file, from 0
    is_reflected: Mask  # (n,) whether it is a reflection, not a line of sight
    bounce_m: Array  # (n, 3) point of reflection
    gain_db: Array  # (n,) 20 log10 of the amplitude
    delay_s: Array  # (n,) absolute delay
    # arrival (at the receiver), departure (at the station): (n, 2) azimuth and zenith angle, rad,
    # of the direction of propagation or of its opposite (see :func:`propagation`)
    arrival: Array
    departure: Array
    # function that takes an array's name and an epoch, and returns the array's file and a row in it
    source: Callable[[str, int], tuple[Path, int]]

    def refuse(self, key: str, epoch: int, value: str, expected: str) -> NoReturn:
        """Raise a ValueError that names the file of the array ``key`` and an epoch's receiver."""
        file, receiver = self.source(key, epoch)
        raise ValueError(
            f"{file}: {key}: found {value} of receiver {receiver}, expected {expected}"
        )

    def refuse_path(self, key: str, n: int, value: str, expected: str) -> NoReturn:
        """Raise a ValueError about a path, which also names the path."""
        self.refuse(key, self.epoch[n], f"{value} on path {self.path[n]}", expected)


def propagation(angles: Array, sight: Array, direct: Mask) -> Array:
    """Compute unit vectors (n, 3) along propagation from azimuths and zenith angles (n, 2).

    Some converters store the direction of propagation, others its opposite. Paths on the line of
    sight (``direct``) propagate along ``sight`` (n, 3), so they show which direction is stored.
    """
    azimuth, zenith = angles.T
    horizontal = np.sin(zenith)
    unit = np.column_stack(
        [horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.cos(zenith)]
    )
    along = np.sum(unit * sight, axis=1)[direct]
    return unit if np.median(along) > 0.0 else -unit


_FLAT = 0.7  # a mirror is the ground, not a wall, if its normal is steeper than 45 degrees
_ROW_KEYS = ("delay", "aoa_az", "aoa_el", "aod_az")  # names of arrays, in the order of ``LINK``
_TOLERANCES = (2.0 * TOLERANCE_M, 0.02, 0.02, 0.02)  # m, rad; wrong conventions cause larger errors


class StationLinks(NamedTuple):
    """The anchors that the paths of a station lead to, and the paths' noise-free measurements."""

    paths: StationPaths  # n paths of the station
    anchors_m: Array  # (K, 3) position of the station, then of its images, in the order found
    member: Index  # (n,) index of the anchor that a path leads to
    rows: Array  # (n, 4) values in the order of ``LINK``, m, rad

    @property
    def is_ground(self) -> Mask:
        """Return which anchors (K,) are images in the ground, a mirror below the station."""
        normal = self.anchors_m[0] - self.anchors_m
        return np.asarray(normal[:, 2] > _FLAT * np.linalg.norm(normal, axis=1))

    def strongest(self, anchor: int) -> Index:
        """Return the indices of the strongest paths to an anchor, one for each epoch with any."""
        own = np.flatnonzero(self.member == anchor)
        own = own[np.argsort(-self.paths.gain_db[own], kind="stable")]
        _, first = np.unique(self.paths.epoch[own], return_index=True)
        return own[first]


def find_links(paths: StationPaths, position_m: Array) -> StationLinks:
    """Find the anchor of each path from a station to receivers at positions (E, 3).

    Raises:
        ValueError: a path contradicts the positions of receiver and anchor, or has a gain above
            0 dB, or there is no line of sight; the message names the file.
    """
    position = position_m[paths.epoch]
    anchors, member = _anchors(paths, position)
    with np.errstate(all="ignore"):  # values that overflow are refused below
        rows = _measure(paths, position, anchors, member)
        _require_geometry(paths, position, anchors[member], rows)
    loud = paths.gain_db > 0.0
    if loud.any():
        n = int(np.argmax(loud))
        paths.refuse_path(
            "power",
            n,
            f"{paths.gain_db[n]:.4g} dB",
            "a gain of at most 0 dB: are the values linear powers instead of dB?",
        )
    return StationLinks(paths, anchors, member, rows)


def _anchors(paths: StationPaths, position: Array) -> tuple[Array, Index]:
    """Return the station and its images (K, 3), and the anchor that each path (n,) leads to.

    ``position`` (n, 3) is the position of each path's receiver, here and below.
    """
    from scipy.spatial import cKDTree

    station = paths.position_m
    reflected = paths.is_reflected
    if reflected.all():
        paths.refuse(
            "inter", 0, "no line of sight (0)", "a line of sight in this epoch or a later one"
        )
    q = paths.bounce_m[reflected]
    back = q - position[reflected]
    with np.errstate(all="ignore"):  # a reflection at the receiver itself is refused below
        away = np.linalg.norm(station - q, axis=1, keepdims=True)
        images = q + away * back / np.linalg.norm(back, axis=1, keepdims=True)
    nowhere = ~np.isfinite(images).all(axis=1)
    if nowhere.any():
        n = int(np.argmax(nowhere))
        epoch = paths.epoch[reflected][n]
        paths.refuse("inter_pos", epoch, f"a reflection at {q[n]}, the place", "another point")
    anchors = [station]
    leads = np.full(len(images), -1)
    tree = cKDTree(images)
    for i, image in enumerate(images):
        if leads[i] < 0:
            near = np.array(tree.query_ball_point(image, TOLERANCE_M))
            near = near[leads[near] < 0]
            leads[near] = len(anchors)
            anchors.append(np.median(images[near], axis=0))
    member = np.zeros(len(reflected), np.int64)
    member[reflected] = leads
    return np.array(anchors), member


def _measure(paths: StationPaths, position: Array, anchors: Array, member: Index) -> Array:
    """Compute the values (n, 4) of links, m and rad, as if each path came from its anchor."""
    sight = position - paths.position_m
    direct = ~paths.is_reflected
    arrival = propagation(paths.arrival, sight, direct)
    departure = propagation(paths.departure, sight, direct)
    normal = (anchors[0] - anchors)[member]  # normal of the mirror; zero for the line of sight
    squared = np.maximum(np.sum(normal * normal, axis=1, keepdims=True), np.finfo(float).tiny)
    departure -= 2.0 * np.sum(departure * normal, axis=1, keepdims=True) / squared * normal
    _, azimuth, elevation = direction(list(arrival.T))
    _, leaving, _ = direction(list(departure.T))
    rows = [SPEED_OF_LIGHT * paths.delay_s, azimuth, elevation, wrap(leaving + PI)]
    return np.column_stack(rows)


def _require_geometry(paths: StationPaths, position: Array, anchor: Array, rows: Array) -> None:
    """Refuse links whose values (n, 4) contradict the positions of receiver and anchor (n, 3)."""
    distance, azimuth, elevation = direction(list((position - anchor).T))
    exact = np.column_stack([distance, azimuth, elevation, wrap(azimuth + PI)])
    error = rows - exact
    error[:, 1:] = wrap(error[:, 1:])
    error[:, [1, 3]] *= np.cos(elevation)[:, None]  # azimuths are undefined at the zenith
    wrong = ~(abs(error) <= _TOLERANCES)
    if wrong.any():
        n, row = np.argwhere(wrong)[0].tolist()
        paths.refuse_path(
            _ROW_KEYS[row],
            n,
            f"{LINK[row]} {rows[n, row]:.4f}",
            f"{exact[n, row]:.4f}, seen from the anchor {anchor[n].round(4)}",
        )
