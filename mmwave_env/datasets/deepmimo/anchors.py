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
from mmwave_env.world.checks import refuse_in

TOLERANCE_M = 0.05  # points this close count as equal; rounding to float32 moves points by 1e-4 m
# ``interactions`` has one digit for each interaction on a path; 0 means no interaction.
LINE_OF_SIGHT = 0.0
REFLECTION = 1.0


class StationPaths(NamedTuple):
    """The paths between one base station and E receivers, at most P for each receiver.

    All values of a reflection (``interactions`` 1) are finite, and so are all values of a line of
    sight (``interactions`` 0) except ``bounce_m``. The values of other paths are meaningless.
    """

    position_m: Array  # (3,) position of the station
    interactions: Array  # (E, P) 0 for a line of sight, 1 for one reflection, ...; NaN for no path
    bounce_m: Array  # (E, P, 3) first point of interaction
    gain_db: Array  # (E, P) 20 log10 of the amplitude
    delay_s: Array  # (E, P) absolute delay
    # arrival (at the receiver), departure (at the station): (E, P, 2) azimuth and zenith angle,
    # rad, of the direction of propagation or of its opposite (see :func:`propagation`)
    arrival: Array
    departure: Array
    # function that takes an array's name and an epoch, and returns the array's file and a row in it
    source: Callable[[str, int], tuple[Path, int]]

    def refuse(self, key: str, epoch: int, value: str, expected: str) -> NoReturn:
        """Raise a ValueError that names the file of the array ``key`` and an epoch's receiver."""
        file, receiver = self.source(key, epoch)
        refuse_in(file, key, f"{value} of receiver {receiver}", expected)


def propagation(angles: Array, sight: Array, direct: Mask) -> Array:
    """Compute unit vectors (E, P, 3) along propagation from azimuths and zenith angles (E, P, 2).

    Some converters store the direction of propagation, others its opposite. Paths on the line of
    sight (``direct``) propagate along ``sight`` (E, 1, 3), so they show which direction is stored.
    """
    azimuth, zenith = np.moveaxis(angles, -1, 0)
    horizontal = np.sin(zenith)
    unit = np.stack(
        [horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.cos(zenith)], axis=-1
    )
    along = np.sum(unit * sight, axis=-1)[direct]
    return unit if np.median(along) > 0.0 else -unit


_FLAT = 0.7  # a mirror is the ground, not a wall, if its normal is steeper than 45 degrees
_ROW_KEYS = ("delay", "aoa_az", "aoa_el", "aod_az")  # names of arrays, in the order of ``LINK``
_TOLERANCES = (2.0 * TOLERANCE_M, 0.02, 0.02, 0.02)  # m, rad; wrong conventions cause larger errors


class StationLinks(NamedTuple):
    """The anchors that the paths of a station lead to, and the paths' noise-free measurements."""

    paths: StationPaths  # paths of the station, for E receivers, P paths each
    anchors_m: Array  # (K, 3) position of the station, then of its images, in the order found
    member: Index  # (E, P) index of the anchor that a path leads to; -1 for none
    rows: Array  # (E, P, 4) values in the order of ``LINK``, m, rad; meaningless without an anchor

    @property
    def is_ground(self) -> Mask:
        """Return which anchors (K,) are images in the ground, a mirror below the station."""
        normal = self.anchors_m[0] - self.anchors_m
        return np.asarray(normal[:, 2] > _FLAT * np.linalg.norm(normal, axis=1))

    @property
    def epochs_seen(self) -> Index:
        """Count the epochs in which each anchor (K,) is seen."""
        epoch, path = np.nonzero(self.member >= 0)
        pairs = np.unique(np.column_stack([epoch, self.member[epoch, path]]), axis=0)
        return np.bincount(pairs[:, 1], minlength=len(self.anchors_m))

    def strongest(self, anchor: int) -> tuple[Mask, Index]:
        """Return (E,) whether an anchor is seen, and (E,) the index of its strongest path."""
        leads = self.member == anchor
        return leads.any(axis=1), np.argmax(np.where(leads, self.paths.gain_db, -np.inf), axis=1)


def find_links(paths: StationPaths, position_m: Array) -> StationLinks:
    """Find the anchor of each path from a station to receivers at positions (E, 3).

    Raises:
        ValueError: a path contradicts the positions of receiver and anchor, or has a gain above
            0 dB, or there is no line of sight; the message names the file.
    """
    anchors, member = _anchors(paths, position_m)
    with np.errstate(all="ignore"):  # values that overflow are refused below
        rows = _measure(paths, position_m, anchors, member)
        _require_geometry(paths, position_m, anchors, member, rows)
    gain = (member >= 0) & (paths.gain_db > 0.0)
    if gain.any():
        n, p = np.argwhere(gain)[0].tolist()
        expected = "a gain of at most 0 dB: are the values linear powers instead of dB?"
        paths.refuse("power", n, f"{paths.gain_db[n, p]:.4g} dB on path {p}", expected)
    return StationLinks(paths, anchors, member, rows)


def _anchors(paths: StationPaths, position_m: Array) -> tuple[Array, Index]:
    """Return the station and its images (K, 3), and the anchor that each path (E, P) leads to."""
    from scipy.spatial import cKDTree

    station = paths.position_m
    q = paths.bounce_m
    member = np.where(paths.interactions == LINE_OF_SIGHT, 0, -1)
    if not (member == 0).any():
        expected = "a line of sight in this epoch or a later one"
        paths.refuse("inter", 0, "no line of sight (0)", expected)
    reflected = paths.interactions == REFLECTION
    back = q - position_m[:, None]
    with np.errstate(all="ignore"):  # a reflection at the receiver itself is refused below
        away = np.linalg.norm(station - q, axis=-1, keepdims=True)
        image = q + away * back / np.linalg.norm(back, axis=-1, keepdims=True)
    nowhere = reflected & ~np.isfinite(image).all(axis=-1)
    if nowhere.any():
        n, p = np.argwhere(nowhere)[0].tolist()
        paths.refuse("inter_pos", n, f"a reflection at {q[n, p]}, the place", "another point")
    anchors = [station]
    images = image[reflected]
    leads = np.full(len(images), -1)
    tree = cKDTree(images)
    for i in range(len(images)):
        if leads[i] < 0:
            near = np.array(tree.query_ball_point(images[i], TOLERANCE_M))
            near = np.sort(near[leads[near] < 0])
            leads[near] = len(anchors)
            anchors.append(np.median(images[near], axis=0))
    member[reflected] = leads
    return np.array(anchors), member


def _measure(paths: StationPaths, position_m: Array, anchors: Array, member: Index) -> Array:
    """Compute the values (E, P, 4) of links, m and rad, as if each path came from its anchor."""
    sight = (position_m - paths.position_m)[:, None]
    direct = member == 0
    arrival = propagation(paths.arrival, sight, direct)
    departure = propagation(paths.departure, sight, direct)
    normal = (anchors[0] - anchors)[member]  # normal of the mirror; zero for the line of sight
    squared = np.maximum(np.sum(normal * normal, axis=-1, keepdims=True), np.finfo(float).tiny)
    departure -= 2.0 * np.sum(departure * normal, axis=-1, keepdims=True) / squared * normal
    _, azimuth, elevation = direction(list(np.moveaxis(arrival, -1, 0)))
    _, leaving, _ = direction(list(np.moveaxis(departure, -1, 0)))
    rows = [SPEED_OF_LIGHT * paths.delay_s, azimuth, elevation, wrap(leaving + PI)]
    return np.stack(rows, axis=-1)


def _require_geometry(
    paths: StationPaths, position_m: Array, anchors: Array, member: Index, rows: Array
) -> None:
    """Refuse links whose values (E, P, 4) contradict the positions of receiver and anchor."""
    offset = position_m[:, None] - anchors[member]
    distance, azimuth, elevation = direction(list(np.moveaxis(offset, -1, 0)))
    exact = np.stack([distance, azimuth, elevation, wrap(azimuth + PI)], axis=-1)
    error = np.abs(rows - exact)
    error[..., 1:] = np.abs(wrap(rows[..., 1:] - exact[..., 1:]))
    error[..., [1, 3]] *= np.cos(elevation)[..., None]  # azimuths are undefined at the zenith
    wrong = (member >= 0)[..., None] & ~(error <= _TOLERANCES)
    if wrong.any():
        n, p, row = np.argwhere(wrong)[0].tolist()
        key = _ROW_KEYS[row]
        seen_from = anchors[member[n, p]].round(4)
        expected = f"{exact[n, p, row]:.4f}, seen from the anchor {seen_from}"
        paths.refuse(key, n, f"{LINK[row]} {rows[n, p, row]:.4f} on path {p}", expected)
