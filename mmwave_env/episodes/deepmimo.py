"""Recordings from DeepMIMO v4 scenarios, whose receivers are the epochs of one track.

The scenario lists paths; a recording wants links to anchors. The line of sight is the link
to the physical gNB. A path that bounces once, at q, looks to a receiver at p as if it came
in a straight line from the mirror image of the gNB at g (paper, Sec. II):

    a = q + |g - q| (q - p) / |q - p|

For one flat wall that image is the same from everywhere, so clusters of images are the
virtual anchors. Arrival and range hold as they are seen from a virtual anchor; the departure
is measured at the gNB, before the bounce, and is mirrored along with it.

Paths of other kinds (two bounces, diffraction, scattering, transmission) have no fixed image
and are left out.
"""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env.episodes.deepmimo_files import (
    LINE_OF_SIGHT,
    REFLECTION,
    TOLERANCE_M,
    Scenario,
    read_scenario,
)
from mmwave_env.episodes.recorded import Recording
from mmwave_env.models.measurement import LINK, SPEED_OF_LIGHT, Layout, direction, range_rate
from mmwave_env.numerics.arrays import Array, Mask
from mmwave_env.numerics.numbers import PI, wrap

_FLAT = 0.7  # a mirror's normal rises more than it leads sideways: ground, not wall
_ROW_KEYS = ("delay", "aoa_az", "aoa_el", "aod_az")  # where the rows of a link come from
_TOLERANCES = (2.0 * TOLERANCE_M, 0.02, 0.02, 0.02)  # m, rad; tells conventions, not noise


def read_deepmimo(
    folder: str | os.PathLike[str],
    virtual_anchors: int = 2,
    ground: bool = False,
    bandwidth_hz: float = 100e6,
) -> Recording:
    """The recording of a scenario folder, with times and velocities from ``trajectory.csv``.

    Args:
        folder: of a static scenario with one transmitter.
        virtual_anchors: how many at most; those seen in most epochs are kept.
        ground: whether the image in the ground counts as an anchor.
        bandwidth_hz: of the signal. The scenario's own is the ray tracer's, which no path
            depends on.

    Raises:
        FileNotFoundError: the folder or one of its files is missing.
        ValueError: a file is damaged, contradicts another or holds what is not understood;
            the message names file, key, value and what was expected.
    """
    if virtual_anchors < 0:
        raise ValueError(f"virtual_anchors: found {virtual_anchors}, expected at least 0")
    scenario = read_scenario(Path(folder))
    anchors, member = _anchors(scenario)
    paths = _measure(scenario, anchors, member)
    _require_geometry(scenario, anchors, member, paths)
    gnb, position = anchors[0], scenario.position_m
    seen = [(member == k).any(axis=1) for k in range(len(anchors))]
    images = [k for k in range(1, len(anchors)) if ground or not _is_below(anchors[k], gnb)]
    images.sort(key=lambda k: -np.count_nonzero(seen[k]))
    kept = [0, *images[:virtual_anchors]]

    layout = Layout(len(kept))
    epochs = np.arange(len(position))
    measurement = np.zeros((len(position), layout.size))
    gain_db = np.zeros((len(position), layout.anchors))
    for a, k in enumerate(kept):
        strongest = np.argmax(np.where(member == k, scenario.power_db, -np.inf), axis=1)
        measurement[:, layout.link(a)] = paths[epochs, strongest]
        gain_db[:, a] = scenario.power_db[epochs, strongest]
    hz_per_mps = scenario.carrier_hz / SPEED_OF_LIGHT
    rate = range_rate(list((position - gnb).T), list(scenario.velocity_mps.T))
    measurement[:, layout.doppler] = hz_per_mps * rate
    return Recording(
        name=scenario.folder.resolve().name,
        anchors_m=anchors[kept],
        carrier_hz=scenario.carrier_hz,
        bandwidth_hz=bandwidth_hz,
        time_s=scenario.time_s,
        measurement=measurement,
        visible=np.column_stack([seen[k] for k in [*kept, 0]]),  # Doppler: line of sight
        path_gain_db=gain_db,
        position_m=position,
        velocity_mps=scenario.velocity_mps,
        layout=layout,
    )


def _anchors(scenario: Scenario) -> tuple[Array, NDArray[np.int_]]:
    """The gNB and all its images (K, 3), and which of them each path (N, P) leads to; -1: none."""
    gnb, q = scenario.transmitter_m, scenario.bounce_m
    member = np.where(scenario.interactions == LINE_OF_SIGHT, 0, -1)
    if not (member == 0).any():
        scenario.refuse("inter", "no line-of-sight path (0)", "at least one")
    reflected = scenario.interactions == REFLECTION
    back = q - scenario.position_m[:, None]
    with np.errstate(all="ignore"):  # a reflection at the receiver itself is refused below
        away = np.linalg.norm(gnb - q, axis=-1, keepdims=True)
        image = q + away * back / np.linalg.norm(back, axis=-1, keepdims=True)
    nowhere = reflected & ~np.isfinite(image).all(axis=-1)
    if nowhere.any():
        n, p = np.argwhere(nowhere)[0]
        scenario.refuse("inter_pos", f"{q[n, p]} for receiver {n}", "a point away from it")
    anchors = [gnb]
    while (left := reflected & (member < 0)).any():
        near = left & (np.linalg.norm(image - image[left][0], axis=-1) <= TOLERANCE_M)
        member[near] = len(anchors)
        anchors.append(np.median(image[near], axis=0))
    return np.array(anchors), member


def _is_below(image: Array, gnb: Array) -> bool:
    """Whether an image is one in the ground: the mirror lies flat, below the gNB."""
    normal = gnb - image
    return bool(normal[2] > _FLAT * np.linalg.norm(normal))


def _measure(scenario: Scenario, anchors: Array, member: NDArray[np.int_]) -> Array:
    """Rows of a link (N, P, 4), m and rad, that each path is to its anchor."""
    direct = member == 0
    arrival = _propagation(scenario, scenario.arrival, direct)
    departure = _propagation(scenario, scenario.departure, direct)
    normal = (anchors[0] - anchors)[member]  # of the mirror; none for the line of sight
    squared = np.maximum(np.sum(normal * normal, axis=-1, keepdims=True), np.finfo(float).tiny)
    departure -= 2.0 * np.sum(departure * normal, axis=-1, keepdims=True) / squared * normal
    _, azimuth, elevation = direction(list(np.moveaxis(arrival, -1, 0)))
    _, leaving, _ = direction(list(np.moveaxis(departure, -1, 0)))
    rows = [SPEED_OF_LIGHT * scenario.delay_s, azimuth, elevation, wrap(leaving + PI)]
    return np.stack(rows, axis=-1)


def _require_geometry(
    scenario: Scenario, anchors: Array, member: NDArray[np.int_], rows: Array
) -> None:
    """Refuse links whose rows (N, P, 4) contradict where receiver and anchor are."""
    offset = scenario.position_m[:, None] - anchors[member]
    distance, azimuth, elevation = direction(list(np.moveaxis(offset, -1, 0)))
    exact = np.stack([distance, azimuth, elevation, wrap(azimuth + PI)], axis=-1)
    error = np.abs(rows - exact)
    error[..., 1:] = np.abs(wrap(rows[..., 1:] - exact[..., 1:]))
    error[..., [1, 3]] *= np.cos(elevation)[..., None]  # at the zenith azimuths mean nothing
    wrong = (member >= 0)[..., None] & ~(error <= _TOLERANCES)
    if wrong.any():
        n, p, row = (int(i) for i in np.argwhere(wrong)[0])
        scenario.refuse(
            _ROW_KEYS[row],
            f"{LINK[row]} {rows[n, p, row]:.4f} on path {p} of receiver {n}",
            f"{exact[n, p, row]:.4f}, seen from the anchor {anchors[member[n, p]].round(4)}",
        )


def _propagation(scenario: Scenario, angles: Array, direct: Mask) -> Array:
    """Unit vectors (N, P, 3) along propagation, from azimuths and zenith angles (N, P, 2).

    Some converters store directions along propagation, some against it; lines of sight tell.
    """
    azimuth, zenith = np.moveaxis(angles, -1, 0)
    horizontal = np.sin(zenith)
    unit = np.stack(
        [horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.cos(zenith)], axis=-1
    )
    sight = (scenario.position_m - scenario.transmitter_m)[:, None]
    along = np.sum(unit * sight, axis=-1)[direct]
    return unit if np.median(along) > 0.0 else -unit
