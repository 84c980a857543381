"""The position that the links of an epoch determine, by nonlinear least squares.

There may be several minima, so the search starts in several places. A minimum counts only if no
other one explains the links about as well.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.models.measurement import NEAREST_M
from mmwave_env.models.radio import BIAS_SIGMA_M
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask

# Standard deviations of the weak prior: of the height around the height of the streets, and of x
# and y around the mean position of the anchors.
HEIGHT_SIGMA_M = 2.0
FARTHEST_M = 1e3
_WORST_FIX_M = 50.0  # maximum horizontal standard deviation of a position to begin a track with
_FAR = 2.0  # standard deviations at which a covariance is compared with the errors
_AMBIGUOUS = 12.0  # minima whose normalized squared errors differ by less than this are ambiguous
UNKNOWN = [0, 1, 2, 7]  # indices of the state's position and range bias
# Searches start around some anchors: where an azimuth points to, else in 12 directions; at the
# measured range, else at three distances.
_SEARCHED = 4
_TURNS = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
STARTS_M = np.array([10.0, 40.0, 160.0])
_ROUNDS = 20
_DAMPING = 1e-3  # before the first round, which divides it by 10
_SETTLED = 1e-6  # a round that reduces the squared errors by less is the last
_SURELY = 3.3  # standard deviations of a difference that noise exceeds once in 1,000 times


class _Links(NamedTuple):
    """The links of an epoch, for least squares, and a weak prior."""

    anchors: Array  # (links, 3)
    z: Array  # (links, 4) range (m) and angles (rad); NaN where not measured
    variance: Array  # (links, 4)
    center: Array  # (unknowns,)
    weight: Array  # (unknowns,) inverse variances around the center
    synchronized: bool  # whether ranges say roughly how far away the anchors are


def position_from_links(
    links: Array, sigma: Array, scene: Scene, clock: str
) -> tuple[Array, Array] | None:
    """Return the position (3,) and its covariance from links (L, 4), NaN if unmeasured; or None.

    If the clock is not synchronized, its range bias is a fourth unknown, with the filters' prior.
    Ranges that no position explains, whatever a free clock's bias is, are left out.
    The search starts in several places, because there may be several minima. The result is None if
    the best minimum is too uncertain, or if a minimum more than 4 standard deviations away from it
    fits the links about as well.
    """
    every = scene.anchors_m[: len(links)]
    visible = np.isfinite(links).any(axis=1)
    z = links[visible]
    sigma = sigma[visible]
    anchors = every[visible]
    reach_m = FARTHEST_M
    if clock == "free":
        apart_m = np.linalg.norm(anchors[:, None] - anchors, axis=2)
        z[_contradicting(z[:, 0], sigma[:, 0], apart_m), 0] = np.nan
    measured = np.isfinite(z)
    azimuths = measured[:, [1, 3]].any(axis=1)
    if clock == "free" and not azimuths.any():
        reach_m = float(apart_m.max(initial=1.0))  # far away, differences of ranges say little
    bias_sigma_m = [BIAS_SIGMA_M[clock]] if clock in BIAS_SIGMA_M else []
    if measured[:, 0].sum() + azimuths.sum() < 2 + len(bias_sigma_m):
        return None  # the height of the streets is known only roughly
    points = anchors[measured[:, 0], :2]
    mirrored = not azimuths.any() and _on_a_line(points)
    if mirrored and scene.side is None:
        return None  # without azimuths, a mirrored position fits as well
    n = 3 + len(bias_sigma_m)
    deviation = [reach_m, reach_m, HEIGHT_SIGMA_M, *bias_sigma_m]
    center = [*every[:, :2].mean(axis=0), scene.streets.height_m, 0.0]
    problem = _Links(
        anchors=anchors,
        z=z,
        variance=sigma**2,
        center=np.array(center[:n]),
        weight=1.0 / np.array(deviation) ** 2,
        synchronized=clock != "free",
    )
    cost, position, information = _descended(problem, _starts(problem), _ROUNDS)
    if mirrored:
        sides = _across(points, position) * _across(points, np.array([scene.side]))
        if not (sides > 0.0).any():
            return None
        cost = np.where(sides > 0.0, cost, np.inf)
    return _best(problem, cost, position, information)


def _best(
    links: _Links, cost: Array, position: Array, information: Array
) -> tuple[Array, Array] | None:
    """Return the best minimum and its covariance; None if it is too uncertain or ambiguous."""
    best = int(np.argmin(cost))
    covariance = np.linalg.inv(information[best])
    stretched = _stretched(links, position[best], cost[best], covariance)
    if stretched is None or np.linalg.eigvalsh(stretched[:2, :2])[-1] > _WORST_FIX_M**2:
        return None
    apart = (position - position[best])[:, :2]
    distance = np.einsum("si,ij,sj->s", apart, np.linalg.inv(covariance[:2, :2]), apart)
    if ((cost - cost[best] < _AMBIGUOUS) & (distance > 16.0)).any():
        return None
    return position[best], stretched


def _stretched(links: _Links, position: Array, cost: float, covariance: Array) -> Array | None:
    """Return the covariance, wider along its longest axis if the errors grow less than it says.

    They do where a user is far from anchors that are near each other: directions almost agree, and
    the user may be much farther away than a Gaussian says. They grow with the square of the inverse
    distance; if this says that the user may be at infinity, the result is None.
    """
    variances, axes = np.linalg.eigh(covariance[:2, :2])
    axis = axes[:, -1]
    step = np.zeros(len(position))
    step[:2] = _FAR * np.sqrt(variances[-1]) * axis
    step[2:] = step[:2] @ np.linalg.solve(covariance[:2, :2], covariance[:2, 2:])
    cost_away, _, _ = _descended(links, position + np.stack([step, -step]), 0)
    growth = float((cost_away - cost).min())
    if not growth > 0.25 * _FAR**2:
        return None
    # With a relative deviation r of the distance, growth = (FAR / (1 + FAR r))^2; on the other side
    # of the minimum, the same growth is reached in FAR / (1 - FAR r) deviations.
    stretch = max(1.0, 1.0 / (2.0 - _FAR / np.sqrt(growth)))
    M = np.eye(len(position))
    M[:2, :2] += (stretch - 1.0) * np.outer(axis, axis)
    return M @ covariance @ M.T  # type: ignore[no-any-return]


def _contradicting(ranges: Array, sigma: Array, apart_m: Array) -> Mask:
    """Tell which ranges (n,) differ by more than their anchors, ``apart_m`` (n, n), are apart.

    Of each two that do, the one with more contradictions is wrong.
    """
    noise = _SURELY * np.hypot(sigma[:, None], sigma)
    conflict = np.abs(ranges[:, None] - ranges) > apart_m + noise
    wrong = np.zeros(len(ranges), np.bool_)
    while conflict.any():
        worst = conflict.sum(axis=0).argmax()
        wrong[worst] = True
        conflict[worst] = conflict[:, worst] = False
    return wrong


def _on_a_line(points: Array) -> bool:
    """Tell whether points (n, 2) are on a line, with deviations of at most 1 % of its length."""
    if len(points) < 3:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 0.01 * spread[0])


def _across(line: Array, points: Array) -> Array:
    """Return values (n,) whose signs say on which side of a line points (n, 2 or more) are."""
    dx, dy = line[-1] - line[0]
    x, y = (points[:, :2] - line[0]).T
    return x * dy - y * dx  # type: ignore[no-any-return]


def _starts(links: _Links) -> Array:
    """Return positions (S, 3 or 4) around the nearest anchors, at the height of the streets."""
    distance, arrival, _, departure = links.z.T
    azimuth = np.where(np.isnan(arrival), departure + np.pi, arrival)
    order = np.lexsort((distance, np.isnan(azimuth)))  # first those with azimuths, then the nearest
    around = []
    for link in order[:_SEARCHED]:
        alone = slice(link, link + 1)
        turns = _TURNS if np.isnan(azimuth[link]) else azimuth[alone]
        known = links.synchronized and np.isfinite(distance[link])
        radii = distance[alone] if known else STARTS_M
        asides = np.multiply.outer(radii, np.stack([np.cos(turns), np.sin(turns)], axis=1))
        around.append(links.anchors[link, :2] + asides.reshape(-1, 2))
    horizontal = np.concatenate(around)
    starts = np.tile(links.center, (len(horizontal), 1))
    starts[:, :2] = horizontal
    return starts


@compiled
def _descended(links, starts, rounds):  # type: ignore[no-untyped-def]
    """Find minima near S starts (S, n) by Levenberg-Marquardt, with at most this number of rounds.

    Return squared errors (S,), positions (S, n) and informations (S, n, n).
    """
    S, n = starts.shape
    costs = np.full(S, np.inf)
    positions = starts.copy()
    informations = np.zeros((S, n, n))
    for s in range(S):
        tried = starts[s]
        best = np.zeros(n)  # -1/2 of the gradient
        damping = _DAMPING
        for _ in range(1 + rounds):
            away = links.center - tried
            gradient = links.weight * away
            information = np.diag(links.weight)
            cost = (gradient * away).sum() + _add_links(links, tried, gradient, information)
            gain = costs[s] - cost
            if cost <= costs[s]:
                costs[s] = cost
                positions[s] = tried
                informations[s] = information
                best = gradient
                damping *= 0.1
                if gain < _SETTLED:
                    break
            else:
                damping *= 10.0
            damped = informations[s] * (1.0 + damping * np.eye(n))
            tried = positions[s] + np.linalg.solve(damped, best)
    return costs, positions, informations


@register_jitable  # type: ignore[untyped-decorator]
def _add_links(links, position, gradient, information):  # type: ignore[no-untyped-def]
    """Add all links at a position to -1/2 of the gradient (n,) and the information (n, n).

    Return the sum of their squared errors. The values of links are described in
    :mod:`mmwave_env.models.measurement`.
    """
    n = len(position)
    cost = 0.0
    bias = position[3:].sum()
    jacobian = np.zeros((4, n))
    jacobian[0, 3:] = 1.0  # the range contains a clock's bias as a summand
    for link in range(len(links.anchors)):
        x = position[0] - links.anchors[link, 0]
        y = position[1] - links.anchors[link, 1]
        z = position[2] - links.anchors[link, 2]
        horizontal = max(np.sqrt(x**2 + y**2), NEAREST_M)
        distance = np.sqrt(horizontal**2 + z**2)
        azimuth = np.arctan2(y, x)
        jacobian[0, 0] = x / distance
        jacobian[0, 1] = y / distance
        jacobian[0, 2] = z / distance
        jacobian[1, 0] = jacobian[3, 0] = -y / horizontal**2
        jacobian[1, 1] = jacobian[3, 1] = x / horizontal**2
        jacobian[2, 0] = -x * z / (horizontal * distance**2)
        jacobian[2, 1] = -y * z / (horizontal * distance**2)
        jacobian[2, 2] = horizontal / distance**2
        expected = (distance + bias, azimuth, np.arctan2(z, horizontal), azimuth + np.pi)
        for row in range(4):
            error = links.z[link, row] - expected[row]
            if np.isnan(error):
                continue
            if row > 0:
                error -= 2.0 * np.pi * np.round(error / (2.0 * np.pi))
            weight = 1.0 / links.variance[link, row]
            cost += weight * error**2
            for i in range(n):
                gradient[i] += weight * jacobian[row, i] * error
                for j in range(n):
                    information[i, j] += weight * jacobian[row, i] * jacobian[row, j]
    return cost
