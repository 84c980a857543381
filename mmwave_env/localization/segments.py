"""Segments of a log, each tracked separately, and their first positions.

A filter can predict for some seconds without a link. After half a minute, its estimate is often far
from the user, and the covariance is too small. So a segment ends after a long gap. The next segment
begins with the next epoch that determines a position; this position is the segment's first fix.

A complete link of the base station gives this position directly. If the log lacks a column that a
complete link needs, or if the user's clock has an offset, the position is computed from all links
of the epoch, by nonlinear least squares with the height of the streets as a weak prior.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M
from mmwave_env.models.measurement import SPEED_OF_LIGHT, Measurement, groups_of
from mmwave_env.models.prior import GAP_S, STEEPEST_FIX_RAD, UNKNOWN_VELOCITY_MPS, prior_from_fix
from mmwave_env.models.radio import CLOCK_OFFSET_S, Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index, Mask

# Standard deviations of the weak prior: of the height around the height of the streets, and of x
# and y around the mean position of the anchors.
HEIGHT_SIGMA_M = 2.0
_FARTHEST_M = 1e3
_WORST_FIX_M = 50.0  # maximum horizontal standard deviation of a position to begin a track with
_AMBIGUOUS = 12.0  # minima whose normalized squared errors differ by less than this are ambiguous
_UNKNOWN = [0, 1, 2, 7]  # indices of the state's position and range bias
# Searches start in 12 directions from every anchor, at three distances, and take at most 15 steps.
_DIRECTIONS = 12
_STARTS_M = (10.0, 40.0, 160.0)
_ROUNDS = 15


class Fix(NamedTuple):
    """A first position, from the links of one epoch."""

    prior: tuple[Array, Array]  # mean (7,), covariance (7, 7); (8,), (8, 8) with a clock offset
    used: Mask  # (groups,) whether each group of measurements was used to compute the prior


def gives_fix(links: Array) -> Mask:
    """Tell which links (n, 4 or more), in m and rad, determine a position to begin a track with.

    Straight above or below an anchor, the azimuth is undefined. Near the vertical, it is so
    uncertain that a Gaussian does not describe the position.
    """
    return (links[:, 0] >= RANGE_LIMITS_M[0]) & (abs(links[:, 2]) <= STEEPEST_FIX_RAD)


def first_fix(row: Log, scene: Scene, radio: Radio) -> Fix | None:
    """Return a position to begin a track with, or None if an epoch (T = 1) determines none.

    A complete link of the base station is used even if it is steeper than :func:`can_begin` allows.
    """
    sigma = radio.sigma(row.snr_db, scene, row.layout)
    sigma = np.where(np.isfinite(row.sigma), row.sigma, sigma)[0]
    link = row.measurement[0, :4]
    used = np.zeros(len(row.layout.groups), np.bool_)
    if _has_whole_link(row):
        used[0] = True
        return Fix(prior_from_fix(scene.anchors_m[0], link, sigma[:4], radio, scene), used)
    if _direct(row):
        return None
    used[: row.layout.anchors] = row.visible[0, : row.layout.anchors]
    solved = _least_squares(row, sigma, scene)
    if solved is None:
        return None
    unknown, covariance = solved
    P = radio.prior_covariance(scene, row.layout.clock)
    among = _UNKNOWN[: len(unknown)]
    P[np.ix_(among, among)] = covariance
    P[3, 3] = P[4, 4] = UNKNOWN_VELOCITY_MPS**2
    return Fix((np.array(_state(unknown)), P), used)


def can_begin(row: Log, scene: Scene, radio: Radio) -> bool:
    """Tell whether an epoch (T = 1) determines a position that a track can begin with."""
    if _has_whole_link(row):
        return bool(gives_fix(row.measurement)[0])
    return first_fix(row, scene, radio) is not None


def _has_whole_link(row: Log) -> bool:
    """Tell whether a complete link of the base station gives an epoch (T = 1) a position."""
    whole = bool(np.isfinite(row.measurement[0, :4]).all())
    return whole and bool(row.visible[0, 0]) and not row.layout.clock


def _least_squares(row: Log, sigma: Array, scene: Scene) -> tuple[Array, Array] | None:
    """Return the position (3,) and its covariance from all links of an epoch (T = 1), or None.

    If the clock is not synchronized, its range bias is a fourth unknown, with the filters' prior.
    The search starts around every anchor, in all directions, because there may be several minima.
    The result is None if the best minimum is too uncertain, or if a minimum more than 4 standard
    deviations away from it fits the links about as well.
    """
    layout = row.layout
    anchors = scene.anchors_m
    measured = np.isfinite(row.measurement[0]).astype(float)
    has_link = row.visible[0, : layout.anchors]
    links = measured[: layout.doppler].reshape(-1, 4)[has_link]
    if not links[:, [1, 3]].any() and _on_a_line(anchors[has_link, :2]):
        return None  # without azimuths, a mirrored position fits as well
    values = np.nan_to_num(row.measurement[0]).tolist()
    visible = row.visible[0].astype(float).tolist()
    noise = np.where(measured > 0.5, sigma**2, 1.0).tolist()
    epoch = Measurement(
        anchors.tolist(), scene.hz_per_mps, values, noise, visible, layout, measured.tolist(),
        np.eye(layout.anchors)[0].tolist(),
    )  # fmt: skip
    n = 3 + layout.clock
    center = np.array([*anchors[:, :2].mean(axis=0), scene.streets.height_m, 0.0][:n])
    deviation = [_FARTHEST_M, _FARTHEST_M, HEIGHT_SIGMA_M, SPEED_OF_LIGHT * CLOCK_OFFSET_S]
    weight = 1.0 / np.array(deviation[:n]) ** 2
    unknown = _UNKNOWN[:n]

    def normal(position: Array) -> tuple[float, Array, Array]:
        """Return the squared error, -1/2 times its gradient, and the information matrix."""
        links = groups_of(_state(position), epoch)[: layout.anchors]
        e = np.array([value for link in links for value in link.innovation])
        H = np.array([[g[i] for i in unknown] for link in links for g in link.jacobian])
        w = 1.0 / np.array([value for link in links for value in link.variance])
        azimuth_nis = sum(float(link.spare_nis) for link in links)  # of azimuth differences
        away = center - position
        cost = float((w * e * e).sum() + (weight * away * away).sum()) + azimuth_nis
        return cost, H.T @ (w * e) + weight * away, (H.T * w) @ H + np.diag(weight)

    descents = (_descend(normal, start) for start in _starts(anchors, center))
    solutions = sorted(descents, key=lambda solution: solution[0])
    cost, position, information = solutions[0]
    covariance = np.linalg.inv(information).astype(float)
    if np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]) > _WORST_FIX_M:
        return None
    for other, elsewhere, _ in solutions[1:]:
        apart = (elsewhere - position)[:2]
        if other - cost < _AMBIGUOUS and apart @ np.linalg.solve(covariance[:2, :2], apart) > 16.0:
            return None
    return position, covariance


def _on_a_line(points: Array) -> bool:
    """Tell whether points (n, 2) are on a line, with deviations of at most 1 % of its length."""
    if len(points) < 3:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 0.01 * spread[0])


def _state(unknown: Array) -> list[float]:
    """Return the state of a user at rest, given its position and possibly its range bias."""
    return [*unknown[:3].tolist(), *[0.0] * 4, *unknown[3:].tolist()]


def _starts(anchors: Array, center: Array) -> Iterator[Array]:
    """Yield positions around every anchor, at the height of the streets."""
    turns = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    for anchor in anchors:
        for distance in _STARTS_M:
            for turn in turns:
                aside = distance * np.array([np.cos(turn), np.sin(turn)])
                yield np.array([*(anchor[:2] + aside), *center[2:]])


def _descend(
    normal: Callable[[Array], tuple[float, Array, Array]], position: Array
) -> tuple[float, Array, Array]:
    """Find a minimum near a start by Gauss-Newton; return squared error, position, information."""
    cost, gradient, information = normal(position)
    for _ in range(_ROUNDS):
        step = np.linalg.solve(information, gradient)
        for _ in range(5):
            new = normal(position + step)
            if new[0] <= cost:
                break
            step *= 0.5
        else:
            break
        improved = cost - new[0]
        position = position + step
        cost, gradient, information = new
        if improved < 1e-6:
            break
    return cost, position, information


def segments(log: Log, scene: Scene, radio: Radio) -> list[slice]:
    """Return the epochs of each segment of a log; the first epoch of a segment gives its prior.

    A segment ends if all links and odometry are missing for more than ``GAP_S``, or before an epoch
    that the log marks in ``restarts``. The next segment begins with the next epoch that has a fix.

    Raises:
        LogError: the log is damaged, and no epoch before the damage determines a position.
        ValueError: no epoch determines a position with which a track could begin.
    """
    ends = np.append(_ends(log), len(log))
    parts: list[slice] = []
    first = _first_fix(log, 0, scene, radio)
    while first < len(log):
        end = int(ends[np.searchsorted(ends, first, side="right")])
        parts.append(slice(first, end))
        first = _first_fix(log, end, scene, radio)
    if not parts:
        raise log.damage or ValueError(
            f"log: found {len(log)} epochs, none of which determines a position, expected an epoch "
            f"in which anchor 1 has a range of at least {RANGE_LIMITS_M[0]:g} m, an SNR and all "
            f"angles (elevation at most {np.degrees(STEEPEST_FIX_RAD):g} degrees). If columns are "
            "missing or the clock has an offset, the links of an epoch must together determine a "
            "single position (without azimuths, anchors on a line leave two)"
        )
    return parts


def _direct(log: Log) -> bool:
    """Tell whether a track can begin only with a complete link of the base station."""
    return log.whole_columns and not log.layout.clock


def _first_fix(log: Log, start: int, scene: Scene, radio: Radio) -> int:
    """Return the first epoch with a fix, from ``start`` on; the log's length if there is none."""
    links = 1 if _direct(log) else log.layout.anchors
    for epoch in np.flatnonzero(log.visible[start:, :links].any(axis=1)) + start:
        if can_begin(log.part(slice(epoch, epoch + 1)), scene, radio):
            return int(epoch)
    return len(log)


def _ends(log: Log) -> Index:
    """Return the epochs before which a segment ends, if there is one."""
    measured = log.visible[:, : log.layout.anchors].any(axis=1)
    if log.layout.odometry:  # with odometry alone, a filter keeps the track for two minutes
        measured |= log.visible[:, -1]
    latest = np.maximum.accumulate(np.where(measured, log.time_s, -np.inf))
    ends = log.restarts.copy()
    ends[1:] |= log.time_s[1:] - latest[:-1] > GAP_S
    return np.flatnonzero(ends)
