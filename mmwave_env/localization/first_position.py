"""The position that the links of an epoch determine, by nonlinear least squares.

There may be several minima, so the search starts in several places. A minimum counts only if no
other one explains the links about as well. Eight searches run at once, one in each SIMD lane.
If the links contradict each other, and most of them agree, the others are left out, as receivers
of satellite signals do (receiver autonomous integrity monitoring, RAIM; Kaplan and Hegarty,
*Understanding GPS/GNSS*, 2017). If it is unclear which links are wrong, the covariance is larger.
"""

from functools import cache
from itertools import repeat
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from mmwave_env.compiler.advance import call
from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import Program, blocks_of, fill, rows_of
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.measurement import link_group
from mmwave_env.models.radio import BIAS_SIGMA_M
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import (
    backward,
    cholesky,
    dot,
    forward,
    minus,
    pack,
    plus,
    product,
    symmetric,
    times,
    unpack,
)
from mmwave_env.numerics.numbers import Array, Index, Mask, Number, Numbers, where
from mmwave_env.numerics.pytree import flatten, select, unflatten

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
_CONTRADICT = 0.01  # links contradict each other if noise makes such errors more seldom
_FEWEST = 3  # links among which one can be told to be wrong


class _Links(NamedTuple):
    """The links of an epoch, for least squares: arrays (4, links), and a weak prior."""

    anchors: Array  # (3, links)
    z: Array
    variance: Array
    measured: Array
    center: Array  # (unknowns,)
    weight: Array  # (unknowns,) inverse variances around the center
    synchronized: bool  # whether ranges say roughly how far away the anchors are


class Fix(NamedTuple):
    """A position from links."""

    position: Array  # (3,), or (4,) with the clock's range bias
    covariance: Array
    used: Index  # indices of the links that determined it
    agree: bool  # whether all links agree, and have more values than there are unknowns


def position_from_links(links: Array, sigma: Array, scene: Scene, clock: str) -> Fix | None:
    """Return the position and its covariance from links (L, 4), NaN if unmeasured; or None.

    If the clock is not synchronized, its range bias is a fourth unknown, with the filters' prior.
    Ranges that no position explains, whatever a free clock's bias is, are left out; so are a
    minority of links without which the others agree.
    The search starts in several places, because there may be several minima. The result is None if
    the best minimum is too uncertain, or if a minimum more than 4 standard deviations away from it
    fits the links about as well.
    """
    every = scene.anchors_m[: len(links)]
    visible = np.flatnonzero(np.isfinite(links).any(axis=1))
    z = links[visible].T
    deviations = sigma[visible].T
    anchors = every[visible]
    reach_m = FARTHEST_M
    if clock == "free":
        apart_m = np.linalg.norm(anchors[:, None] - anchors, axis=2)
        z[0, _contradicting(z[0], deviations[0], apart_m)] = np.nan
    measured = np.isfinite(z)
    azimuths = measured[[1, 3]].any(axis=0)
    if clock == "free" and not azimuths.any():
        reach_m = float(apart_m.max(initial=1.0))  # far away, differences of ranges say little
    bias_sigma_m = [BIAS_SIGMA_M[clock]] if clock in BIAS_SIGMA_M else []
    if measured[0].sum() + azimuths.sum() < 2 + len(bias_sigma_m):
        return None  # the height of the streets is known only roughly
    points = anchors[measured[0], :2]
    mirrored = not azimuths.any() and on_a_line(points)
    if mirrored and scene.side is None:
        return None  # without azimuths, a mirrored position fits as well
    deviation = [reach_m, reach_m, HEIGHT_SIGMA_M, *bias_sigma_m]
    center = [*every[:, :2].mean(axis=0), scene.streets.height_m, 0.0][: len(deviation)]
    problem = _Links(
        anchors=anchors.T,
        z=np.where(measured, z, 0.0),
        variance=np.where(measured, deviations**2, 1.0),
        measured=measured.astype(float),
        center=np.array(center),
        weight=1.0 / np.array(deviation) ** 2,
        synchronized=clock != "free",
    )
    cost, position, information = _descended(problem, _starts(problem))
    if mirrored:
        sides = across(points, position) * across(points, np.array([scene.side]))
        if not (sides > 0.0).any():
            return None
        cost = np.where(sides > 0.0, cost, np.inf)
    best = int(np.argmin(cost))
    wrong = _wrong_links(problem, cost[best], position[best])
    if wrong:
        others = links.copy()
        others[visible[wrong]] = np.nan
        fix = position_from_links(others, sigma, scene, clock)
        return fix and fix._replace(agree=False)
    covariance = _covariance(problem, best, cost, position, information)
    if covariance is None:
        return None
    agree = _agree(problem, cost[best]) and measured.sum() > len(deviation)
    return Fix(position[best], covariance, visible, agree)


def _wrong_links(links: _Links, cost: float, position: Array) -> list[int]:
    """Return links without which the others agree, given the best minimum with all of them.

    The one without which the errors fall most is left out first. The list is empty if all agree,
    or if it is unclear which links are wrong.
    """
    among = list(range(links.z.shape[1]))
    fewest = max(_FEWEST, len(among) // 2 + 1)
    wrong: list[int] = []
    clear = True
    while not _agree(links, cost):
        if len(among) < fewest:
            return []
        minima = [_descended(_without(links, i), position[None]) for i in range(len(among))]
        costs = np.array([minimum[0][0] for minimum in minima])
        best, second = np.argsort(costs)[:2].tolist()
        clear = bool(costs[second] - costs[best] > _AMBIGUOUS)
        links = _without(links, best)
        cost = costs[best]
        position = minima[best][1][0]
        wrong.append(among.pop(best))
    return wrong if clear else []


def _without(links: _Links, link: int) -> _Links:
    """Return links without one of them."""
    arrays = {name: np.delete(getattr(links, name), link, axis=1) for name in _Links._fields[:4]}
    return links._replace(**arrays)


def _agree(links: _Links, cost: float) -> bool:
    """Tell whether noise explains the squared errors of links."""
    return bool(cost <= chdtri(links.measured.sum(), _CONTRADICT))


def _covariance(
    links: _Links, best: int, cost: Array, position: Array, information: Array
) -> Array | None:
    """Return the covariance of the best minimum; None if it is too uncertain or ambiguous."""
    covariance = np.linalg.inv(information[best])
    stretched = _stretched(links, position[best], cost[best], covariance)
    if stretched is None or np.linalg.eigvalsh(stretched[:2, :2])[-1] > _WORST_FIX_M**2:
        return None
    apart = (position - position[best])[:, :2]
    distance = np.einsum("si,ij,sj->s", apart, np.linalg.inv(covariance[:2, :2]), apart)
    if ((cost - cost[best] < _AMBIGUOUS) & (distance > 16.0)).any():
        return None
    if not _agree(links, cost[best]):
        stretched *= cost[best] / links.measured.sum()  # reduced chi-square
    return stretched


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
    cost_away, _, _ = _descended(links, position + np.stack([step, -step]), rounds=0)
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


def on_a_line(points: Array) -> bool:
    """Tell whether points (n, 2 or 3) are on a line: at most 1 % of its length away from it."""
    if len(points) < 3:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= 0.01 * spread[0])


def across(line: Array, points: Array) -> Array:
    """Return values (n,) whose signs say on which side of a line points (n, 2 or more) are.

    They are distances from the line, times its length.
    """
    dx, dy = line[-1] - line[0]
    x, y = (points[:, :2] - line[0]).T
    return x * dy - y * dx  # type: ignore[no-any-return]


def _starts(links: _Links) -> Array:
    """Return positions (S, 3 or 4) around the nearest anchors, at the height of the streets."""
    distance, arrival, _, departure = np.where(links.measured > 0.5, links.z, np.nan)
    azimuth = np.where(np.isnan(arrival), departure + np.pi, arrival)
    order = np.lexsort((distance, np.isnan(azimuth)))  # first those with azimuths, then the nearest
    around = []
    for link in order[:_SEARCHED]:
        alone = slice(link, link + 1)
        turns = _TURNS if np.isnan(azimuth[link]) else azimuth[alone]
        known = links.synchronized and np.isfinite(distance[link])
        radii = distance[alone] if known else STARTS_M
        asides = np.multiply.outer(radii, np.stack([np.cos(turns), np.sin(turns)], axis=1))
        around.append(links.anchors[:2, link] + asides.reshape(-1, 2))
    horizontal = np.concatenate(around)
    starts = np.tile(links.center, (len(horizontal), 1))
    starts[:, :2] = horizontal
    return starts


class _Sums(NamedTuple):
    """A sum over links of squared errors, -1/2 of its gradient (n,), and the information (n, n)."""

    cost: Number
    gradient: Numbers
    information: Numbers  # packed


class _Search(NamedTuple):
    """A search for a minimum by Levenberg-Marquardt, over positions (n,) with n = 3 or 4."""

    # anchor, z, variance and measured of the next link to be added, as for
    # :func:`~mmwave_env.models.measurement.link_group`
    link: list[Numbers]
    center: Numbers  # (n,) the weak prior
    weight: Numbers
    tried: Numbers  # (n,) position, and what was added up there
    sums: _Sums
    position: Numbers  # (n,) best position so far, and the sums there
    best: _Sums
    damping: Number
    settled: Number  # 1 if the last round hardly improved the position, else 0


def _with_link(search: _Search) -> _Search:
    """Add a link to the sums at the tried position."""
    position = search.tried
    n = len(position)
    x = [*position[:3], *[0.0] * (STATE_SIZE - 3), *position[3:]]
    group = link_group(x, *search.link)
    H = [[row[i] for i in UNKNOWN[:n]] for row in group.jacobian]
    weighted = [[d / v for d in row] for row, v in zip(H, group.variance, strict=True)]
    e = group.innovation
    squares = [a * a / v for a, v in zip(e, group.variance, strict=True)]
    columns = list(zip(*weighted, strict=True))
    gradient = [dot(column, e) for column in columns]
    information = product(columns, H)
    own = _Sums(sum(squares, group.spare_nis), gradient, pack(information))
    return search._replace(sums=_added(search.sums, own))


def _added(a: _Sums, b: _Sums) -> _Sums:
    return unflatten(a, iter(plus(flatten(a), flatten(b))))


def _next_round(search: _Search) -> _Search:
    """Compare the tried position with the best one; try another one, without sums yet."""
    away = minus(search.center, search.tried)
    pull = times(search.weight, away)
    n = len(pull)
    weak = symmetric(n, lambda i, j: search.weight[i] if i == j else 0.0)
    now = _added(search.sums, _Sums(dot(pull, away), pull, pack(weak)))
    cost = search.best.cost
    better = now.cost <= cost
    best = select(better, now, search.best)
    position = select(better, search.tried, search.position)
    damping = search.damping * where(better, 0.1, 10.0)
    information = unpack(best.information)
    damped = symmetric(n, lambda i, j: information[i][j] * (1.0 + damping if i == j else 1.0))
    factor = cholesky(damped)
    step = backward(factor, forward(factor, best.gradient))
    return search._replace(
        tried=plus(position, step),
        sums=unflatten(now, repeat(0.0)),
        position=position,
        best=best,
        damping=damping,
        settled=where(better & (cost - now.cost < _SETTLED), 1.0, 0.0),
    )


@cache
def _programs(n: int) -> tuple[Program[_Search], Program[_Search]]:
    """Return :func:`_with_link` and :func:`_next_round`, compiled for positions (n,)."""
    many = [0.0] * n
    sums = _Sums(0.0, many, [0.0] * (n * (n + 1) // 2))
    link = [many[:3], *[[1.0] * 4] * 3]
    start = _Search(link, many, many, many, sums, many, sums._replace(cost=np.inf), _DAMPING, 0.0)
    return Program(_with_link, start), Program(_next_round, start)


@compiled
def _run_rounds(add_link, end_round, settled, links, blocks, rounds):  # type: ignore[no-untyped-def]
    """Run rounds of searches until all have settled in the same round.

    Args:
        add_link, end_round: addresses of compiled programs.
        settled: row of a workspace.
        links: (links, numbers) each link's numbers, the first rows of a workspace.
        blocks: (blocks, rows, 8) workspaces of the searches, changed in place.
        rounds: number of rounds; the errors at the starts are added up before the first.
    """
    for _ in range(1 + rounds):
        unsettled = 0
        for block in blocks:
            for link in links:
                for i in range(len(link)):
                    block[i] = link[i]
                call(add_link, (block.ctypes.data,))
            call(end_round, (block.ctypes.data,))
            for lane in range(WIDTH):
                unsettled += block[settled, lane] < 0.5
        if unsettled == 0:
            return


def _descended(links: _Links, starts: Array, rounds: int = _ROUNDS) -> tuple[Array, Array, Array]:
    """Find minima near S starts (S, n), in at most this number of rounds.

    Return squared errors (S,), positions (S, n) and informations (S, n, n).
    """
    S, n = starts.shape
    add_link, end_round = _programs(n)
    at = add_link.index
    blocks = blocks_of(add_link.start, S)
    blocks[:, at.center] = links.center[:, None]
    blocks[:, at.weight] = links.weight[:, None]
    fill(blocks, rows_of(at.tried), starts[np.arange(len(blocks) * WIDTH) % S])
    rows = np.concatenate(links[:4]).T.copy()
    _run_rounds(add_link.on_lanes(), end_round.on_lanes(), at.settled, rows, blocks, rounds)
    ends = blocks.transpose(0, 2, 1).reshape(-1, len(add_link.start))[:S]
    return ends[:, at.best.cost], ends[:, at.position], ends[:, unpack(at.best.information)]
