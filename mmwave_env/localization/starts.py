"""First positions of tracks, from the links of one or several epochs of a log.

A complete link of the base station gives a position directly. Otherwise, the position is computed
from all links of the epoch, by nonlinear least squares with the height of the streets as a weak
prior. Receivers that measure one anchor after the other have one link per epoch; so if an epoch
alone determines no position, the latest links of the second before it help.

The first epochs may be wrong: a receiver that sees the base station only by a reflection measures
a range that is too long, and other angles. So a start is confirmed by *votes*, the positions in
some of the first epochs. If a majority agrees on a straight motion that another vote contradicts,
the track begins from this motion instead.
"""

from collections.abc import Callable
from functools import cache
from itertools import repeat
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from mmwave_env.compiler.advance import call
from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import Program, blocks_of
from mmwave_env.logs.live_log import LiveEpoch, log_from
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.measurement import link_group
from mmwave_env.models.prior import STEEPEST_FIX_RAD, prior_from_fix
from mmwave_env.models.radio import BIAS_SIGMA_M, UNKNOWN_VELOCITY_MPS, Radio
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
from mmwave_env.numerics.numbers import Array, Mask, Number, Numbers, where
from mmwave_env.numerics.pytree import flatten, select, unflatten

# Standard deviations of the weak prior: of the height around the height of the streets, and of x
# and y around the mean position of the anchors.
HEIGHT_SIGMA_M = 2.0
_FARTHEST_M = 1e3
_WORST_FIX_M = 50.0  # maximum horizontal standard deviation of a position to begin a track with
_AMBIGUOUS = 12.0  # minima whose normalized squared errors differ by less than this are ambiguous
_UNKNOWN = [0, 1, 2, 7]  # indices of the state's position and range bias
# Searches start around some anchors: where an azimuth points to, else in 12 directions; at the
# measured range, else at three distances.
_SEARCHED = 4
_TURNS = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
_STARTS_M = np.array([10.0, 40.0, 160.0])
_ROUNDS = 20
_DAMPING = 1e-3  # before the first round, which divides it by 10
_SETTLED = 1e-6  # a round that reduces the squared errors by less is the last
_RANGE_ROW = np.array([[True], [False], [False], [False]])  # the range among the rows of a link
_SURELY = 3.3  # standard deviations of a difference that noise exceeds once in 1,000 times
POOL_S = 1.0  # age up to which earlier links help to determine a first position
VOTES = 5  # positions that confirm a start
# minimum time between votes: between the first ones, between later ones
_SPACING_S = 0.25
_LATER_SPACING_S = POOL_S
# The motion between votes: standard deviations of position, velocity and its change in a second
_POSITION = np.diag([_FARTHEST_M, _FARTHEST_M, HEIGHT_SIGMA_M]) ** 2
_VELOCITY = np.diag([UNKNOWN_VELOCITY_MPS, UNKNOWN_VELOCITY_MPS, 0.5]) ** 2
_WALKS = (0.3, 1.5)
# A vote may be wrong: by this distance (standard deviation per axis), and as seldom as this
# penalty, -2 times the logarithm of a probability of 10 %, says.
_WRONG_M = 5.0
_SELDOM = 4.6
_CAUTION = 4.0  # factor for the covariance of a start from votes, whose links are used again
_DOUBTED_S = 10.0  # time after a start or a long gap in which votes may end a track
_PATIENCE_S = 60.0  # time in which the first votes must come
_JUMP = 3  # votes on each side of a jump
_JUMP_ERROR = 16.0  # minimum reduction of the error by a jump


class Start(NamedTuple):
    """A state to begin a track with."""

    prior: tuple[Array, Array]  # mean (7,), covariance (7, 7); (8,), (8, 8) with a clock offset
    # (k, groups) which groups of the first k epochs the filters must leave out, because the prior
    # was computed from them, or because they contradict it
    spent: Mask


def gives_fix(links: Array) -> Mask:
    """Tell which links (n, 4 or more), in m and rad, determine a position to begin a track with.

    Straight above or below an anchor, the azimuth is undefined. Near the vertical, it is so
    uncertain that a Gaussian does not describe the position.
    """
    return (links[:, 0] >= RANGE_LIMITS_M[0]) & (abs(links[:, 2]) <= STEEPEST_FIX_RAD)


def start_at(log: Log, epoch: int, scene: Scene, radio: Radio) -> Start | None:
    """Return a state to begin a track with at an epoch of a log; None if there is none."""
    row = log.part(slice(epoch, epoch + 1))
    sigma = deviations_of(row, scene, radio)[0]
    link = row.measurement[0, :4]
    spent = np.zeros((1, len(row.layout.groups)), np.bool_)
    whole = bool(np.isfinite(link).all()) and bool(row.visible[0, 0]) and not row.layout.has_bias
    if whole and gives_fix(row.measurement)[0]:
        spent[0, 0] = True
        return Start(prior_from_fix(scene.anchors_m[0], link, sigma[:4], radio, scene), spent)
    links = row.layout.anchors
    elevations = row.measurement[0, 2 : row.layout.doppler : 4]
    if (row.visible[0, :links] & (abs(elevations) > STEEPEST_FIX_RAD)).any():
        return None  # near the vertical, filters can't follow
    spent[0, :links] = row.visible[0, :links]
    solved = _position_at(row, lambda: log.part(slice(epoch + 1)), scene, radio)
    if solved is None:
        return None
    unknown, covariance, _ = solved
    n = row.layout.state_size
    x = np.zeros(n)
    P = radio.prior_covariance(scene, row.layout.clock)
    among = _UNKNOWN[: len(unknown)]
    x[among] = unknown
    P[np.ix_(among, among)] = covariance
    P[3, 3] = P[4, 4] = radio.start_velocity_mps**2
    return Start((x, P), spent)


def _position_at(
    row: Log, until: Callable[[], Log], scene: Scene, radio: Radio
) -> tuple[Array, Array, bool] | None:
    """Return :func:`_solved` for an epoch's links or, if that is None, with earlier ones.

    Also tell whether earlier ones were needed. ``row`` is the epoch (T = 1), and ``until`` returns
    a log that ends with it.
    """
    sigma = deviations_of(row, scene, radio)[0]
    clock = row.layout.clock
    solved = _solved(row.measurement[0], sigma, row.visible[0], scene, clock)
    if solved:
        return *solved, False
    if clock == "free":
        return None  # earlier ranges have another bias
    solved = _solved(*_pooled(until(), scene, radio), scene, clock)
    return (*solved, True) if solved else None


def deviations_of(log: Log, scene: Scene, radio: Radio) -> Array:
    """Return the standard deviations (T, rows): the receiver's own, else the radio's."""
    known = np.isfinite(log.sigma)
    if known.all():
        return log.sigma
    return np.where(known, log.sigma, radio.sigma(log.snr_db, scene, log.layout))


def _pooled(log: Log, scene: Scene, radio: Radio) -> tuple[Array, Array, Mask]:
    """Return the latest measurement (rows,) of every row in the second before the last epoch.

    Also return standard deviations (rows,), which allow for an unknown motion since then, and the
    groups (groups,) that were measured.
    """
    now = log.time_s[-1]
    recent = log.part(slice(int(np.searchsorted(log.time_s, now - POOL_S)), None))
    layout = log.layout
    measurement = np.full(layout.size, np.nan)
    sigma = np.full(layout.size, np.nan)
    visible = np.zeros(len(layout.groups), np.bool_)
    deviations = deviations_of(recent, scene, radio)
    for t in range(len(recent)):
        moved_m = radio.start_velocity_mps * (now - recent.time_s[t])
        for group in np.flatnonzero(recent.visible[t, : layout.anchors]).tolist():
            rows = layout.link(group)
            z = recent.measurement[t, rows]
            distance = z[0] if np.isfinite(z[0]) else _STARTS_M[0]
            moved = moved_m / np.array([1.0, *[max(distance, 1.0)] * 3])
            some = np.isfinite(z)
            measurement[rows] = np.where(some, z, measurement[rows])
            grown = np.hypot(deviations[t, rows], moved)
            sigma[rows] = np.where(some, grown, sigma[rows])
            visible[group] = True
    return measurement, sigma, visible


class _Links(NamedTuple):
    """The links of an epoch, for least squares: arrays (4, links), and a weak prior."""

    anchors: Array  # (3, links)
    z: Array
    variance: Array
    measured: Array
    center: Array  # (unknowns,)
    weight: Array  # (unknowns,) inverse variances around the center
    synchronized: bool  # whether ranges say roughly how far away the anchors are


def _solved(
    measurement: Array, sigma: Array, visible: Mask, scene: Scene, clock: str
) -> tuple[Array, Array] | None:
    """Return the position (3,) and its covariance from links, or None.

    If the clock is not synchronized, its range bias is a fourth unknown, with the filters' prior.
    Ranges that no position explains, whatever a free clock's bias is, are left out.
    The search starts in several places, because there may be several minima. The result is None if
    the best minimum is too uncertain, or if a minimum more than 4 standard deviations away from it
    fits the links about as well.
    """
    every = scene.anchors_m[: len(measurement) // 4]  # four rows per link, and some others
    visible_links = np.flatnonzero(visible[: len(every)])
    z = measurement[: 4 * len(every)].reshape(-1, 4)[visible_links].T
    reach_m = _FARTHEST_M
    if clock == "free":
        points = every[visible_links]
        apart_m = np.linalg.norm(points[:, None] - points, axis=2)
        reach_m = float(apart_m.max(initial=1.0))
        wrong = _contradicting(z[0], sigma[4 * visible_links], apart_m)
        z = np.where(wrong & _RANGE_ROW, np.nan, z)
    measured = np.isfinite(z)
    azimuths = measured[[1, 3]].any(axis=0)
    bias_sigma_m = [BIAS_SIGMA_M[clock]] if clock in BIAS_SIGMA_M else []
    if measured[0].sum() + azimuths.sum() < 2 + len(bias_sigma_m):
        return None  # the height of the streets is known only roughly
    points = every[visible_links[measured[0]], :2]
    mirrored = not azimuths.any() and _on_a_line(points)
    if mirrored and scene.side is None:
        return None  # without azimuths, a mirrored position fits as well
    n = 3 + len(bias_sigma_m)
    deviation = [reach_m, reach_m, HEIGHT_SIGMA_M, *bias_sigma_m]
    center = [*every[:, :2].mean(axis=0), scene.streets.height_m, 0.0]
    links = _Links(
        anchors=every[visible_links].T,
        z=np.where(measured, z, 0.0),
        variance=np.where(
            measured, sigma[: 4 * len(every)].reshape(-1, 4)[visible_links].T ** 2, 1.0
        ),
        measured=measured.astype(float),
        center=np.array(center[:n]),
        weight=1.0 / np.array(deviation) ** 2,
        synchronized=clock != "free",
    )
    cost, position, information = _descended(links, _starts(links))
    if mirrored:
        sides = _across(points, position) * _across(points, np.array([scene.side]))
        if not (sides > 0.0).any():
            return None
        cost = np.where(sides > 0.0, cost, np.inf)
    best = int(np.argmin(cost))
    covariance = np.linalg.inv(information[best])
    if not np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]) <= _WORST_FIX_M:
        return None
    apart = (position - position[best])[:, :2]
    distance = np.einsum("si,ij,sj->s", apart, np.linalg.inv(covariance[:2, :2]), apart)
    if ((cost - cost[best] < _AMBIGUOUS) & (distance > 16.0)).any():
        return None
    return position[best], covariance


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
    distance, arrival, _, departure = np.where(links.measured > 0.5, links.z, np.nan)
    azimuth = np.where(np.isnan(arrival), departure + np.pi, arrival)
    order = np.lexsort((distance, np.isnan(azimuth)))  # first those with azimuths, then the nearest
    around = []
    for link in order[:_SEARCHED]:
        alone = slice(link, link + 1)
        turns = _TURNS if np.isnan(azimuth[link]) else azimuth[alone]
        known = links.synchronized and np.isfinite(distance[link])
        radii = distance[alone] if known else _STARTS_M
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


class _Link(NamedTuple):
    """A link, as for :func:`~mmwave_env.models.measurement.link_group`."""

    anchor: Numbers
    z: Numbers
    variance: Numbers
    measured: Numbers


class _Search(NamedTuple):
    """A search for a minimum by Levenberg-Marquardt, over positions (n,) with n = 3 or 4."""

    link: _Link  # the next link to be added
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
    H = [[row[i] for i in _UNKNOWN[:n]] for row in group.jacobian]
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
    link = _Link(many[:3], *[[1.0] * 4] * 3)
    start = _Search(link, many, many, many, sums, many, sums._replace(cost=np.inf), _DAMPING, 0.0)
    return Program(_with_link, start), Program(_next_round, start)


@compiled
def _run_rounds(add_link, end_round, settled, links, blocks):  # type: ignore[no-untyped-def]
    """Run rounds of searches until all have settled in the same round.

    Args:
        add_link, end_round: addresses of compiled programs.
        settled: row of a workspace.
        links: (links, numbers) each link's numbers, the first rows of a workspace.
        blocks: (blocks, rows, 8) workspaces of the searches, changed in place.
    """
    for _ in range(1 + _ROUNDS):
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


def _descended(links: _Links, starts: Array) -> tuple[Array, Array, Array]:
    """Find minima near S starts (S, n).

    Return squared errors (S,), positions (S, n) and informations (S, n, n).
    """
    S, n = starts.shape
    add_link, end_round = _programs(n)
    at = add_link.index
    blocks = blocks_of(add_link.start, S)
    searches = blocks.transpose(0, 2, 1).reshape(-1, len(add_link.start))
    searches[:, at.center] = links.center
    searches[:, at.weight] = links.weight
    searches[:, at.tried] = starts[np.arange(len(searches)) % S]
    blocks = searches.reshape(len(blocks), WIDTH, -1).transpose(0, 2, 1).copy()
    rows = np.concatenate(links[:4]).T.copy()
    _run_rounds(add_link.on_lanes(), end_round.on_lanes(), at.settled, rows, blocks)
    ends = blocks.transpose(0, 2, 1).reshape(searches.shape)[:S]
    return ends[:, at.best.cost], ends[:, at.position], ends[:, unpack(at.best.information)]


class Vote(NamedTuple):
    """A position in one of the first epochs of a track."""

    epoch: int
    time_s: float
    position: Array  # (3,)
    covariance: Array  # (3, 3)
    pooled: bool  # whether links of earlier epochs were needed


class Ballot:
    """The votes in the first seconds of a track, or after a gap.

    Args:
        scene, radio: the scene and the radio of the log.
    """

    def __init__(self, scene: Scene, radio: Radio) -> None:
        self._scene = scene
        self._radio = radio
        self._votes: list[Vote] = []
        self._jump: int | None = None  # index of the first vote of another motion
        # the vote that may become this one, if the next one explains the votes less well; its gain
        self._candidate: int | None = None
        self._gain = _JUMP_ERROR

    def is_open(self, elapsed_s: float) -> bool:
        """Tell whether an epoch so long after the first one may still vote."""
        if len(self._votes) < VOTES:
            return elapsed_s <= _PATIENCE_S
        # One wrong link makes a pooled vote wrong; so only the first ones are counted.
        return elapsed_s <= _DOUBTED_S and not self._votes[-1].pooled

    @property
    def is_undecided(self) -> bool:
        """Tell whether the next vote may still change the start."""
        return len(self._votes) <= VOTES + _JUMP

    def is_due(self, time_s: float) -> bool:
        """Tell whether an epoch at this time is not too near to the last vote."""
        if not self._votes:
            return True
        last = self._votes[-1]
        few = len(self._votes) < VOTES and not last.pooled  # pooled votes must not share links
        return time_s - last.time_s >= (_SPACING_S if few else _LATER_SPACING_S)

    def add(self, log: Log, epoch: int) -> None:
        """Let an epoch of a log vote, unless it follows another vote at once."""
        if self.is_due(float(log.time_s[epoch])):
            row = log.part(slice(epoch, epoch + 1))
            self.vote(row, epoch, lambda: log.part(slice(epoch + 1)))

    def vote(self, row: Log, epoch: int, until: Callable[[], Log]) -> bool:
        """Let an epoch vote that :meth:`is_due`; tell if it did.

        Args:
            row: the epoch (T = 1).
            epoch: its number.
            until: function that returns a log that ends with this epoch.
        """
        solved = _position_at(row, until, self._scene, self._radio)
        if solved is None:
            return False
        position, covariance, pooled = solved
        time_s = float(row.time_s[0])
        self._votes.append(Vote(epoch, time_s, position[:3], covariance[:3, :3], pooled))
        self._look_for_jump()
        return True

    def _look_for_jump(self) -> None:
        """Look whether another motion begins with the third last vote."""
        first = len(self._votes) - _JUMP
        if self._jump is not None or first < VOTES:
            return
        near = self._votes[first - _JUMP :]
        apart = _errors(near[:_JUMP]).min() + _errors(near[_JUMP:]).min()
        gain = _errors(near).min() - apart
        if gain > self._gain:
            self._gain = gain
            self._candidate = first
        else:
            self._jump = self._candidate

    def jump(self) -> int | None:
        """Return the epoch, not one of the first, at which another motion begins, or None."""
        return None if self._jump is None else self._votes[self._jump].epoch

    def _first_votes(self) -> list[Vote]:
        """Return the votes that decide about the start."""
        return self._votes[: min(VOTES + _JUMP, self._jump or len(self._votes))]

    def contradicts(self) -> bool:
        """Tell whether a majority agrees on a motion that another vote contradicts."""
        return len(self._votes) >= VOTES and bool(_wrong(self._first_votes())[0].any())

    def start(self, log: Log, first: int) -> Start | None:
        """Return the start at an epoch on which a majority agrees; None if nothing contradicts."""
        if len(self._votes) < VOTES:
            return None
        votes = self._first_votes()
        wrong, walk = _wrong(votes)
        if not wrong.any():
            return None
        right = votes[int(wrong.argmin())]
        usual = start_at(log, right.epoch, self._scene, self._radio)
        if usual is None:
            return None
        mean, covariance = _motion(votes, wrong, walk, float(log.time_s[first]))
        x, P = (part.copy() for part in usual.prior)
        horizontal = [0, 1, 3, 4]
        among = np.ix_(horizontal, horizontal)
        x[horizontal] = mean[horizontal]
        P[horizontal] = 0.0
        P[:, horizontal] = 0.0
        P[among] = _CAUTION * covariance[among]
        contradicting = [votes[i].epoch - first for i in np.flatnonzero(wrong)]
        spent = np.zeros((1 + max(contradicting), len(log.layout.groups)), np.bool_)
        spent[contradicting] = True
        return Start((x, P), spent)


class Doubt:
    """The epochs since a start or a gap, whose votes may revise a track that is under way.

    The epochs arrive one by one; the result is the same as that of ``segments.py``, which knows
    all epochs of a log. Each epoch comes with a function ``row`` that returns it as a log (T = 1).

    Args:
        scene, radio: the scene and the radio of the log.
    """

    def __init__(self, scene: Scene, radio: Radio) -> None:
        self._scene = scene
        self._radio = radio
        self._epochs: list[LiveEpoch] = []
        self._first = 0  # index of the epoch with which the track begins, or ends its gap
        self._ballot = Ballot(scene, radio)
        self._revised = False

    def begin(self, epoch: LiveEpoch, row: Callable[[], Log]) -> tuple[Log, Start] | None:
        """Return an epoch (T = 1), and a start with it and the second before it; or None."""
        self._epochs = self._until(epoch)
        self._first = len(self._epochs) - 1
        own = row()
        log = log_from(self._epochs) if self._first else own
        start = start_at(log, self._first, self._scene, self._radio)
        if start is None:
            return None
        self._ballot.add(log, self._first)
        return own, start

    def revise(self, epoch: LiveEpoch, row: Callable[[], Log]) -> tuple[Log, Start] | None:
        """Return the epochs with which to begin again, and their start; None if the track stands.

        ``epoch`` is the next epoch, the last one of the epochs that are returned.
        """
        ballot = self._ballot
        self._epochs.append(epoch)
        if not ballot.is_due(epoch.time_s):
            return None
        last = len(self._epochs) - 1
        if not ballot.vote(row(), last, lambda: log_from(self._until(epoch))):
            return None
        jump = ballot.jump()
        undecided = ballot.is_undecided and (self._revised or ballot.contradicts())
        if jump is None and not undecided:
            return None
        log = log_from(self._epochs)
        if jump is not None:
            self._first = jump
            self._ballot = Ballot(self._scene, self._radio)
            for later in range(jump, len(log)):
                self._ballot.add(log, later)
        start = self._ballot.start(log, self._first)
        revised = start is not None
        if start is None and (self._revised or jump is not None):
            start = start_at(log, self._first, self._scene, self._radio)
        self._revised = revised
        return (log.part(slice(self._first, None)), start) if start else None

    def _until(self, epoch: LiveEpoch) -> list[LiveEpoch]:
        """Return the epochs of the second before an epoch, and this epoch."""
        since_s = epoch.time_s - POOL_S
        before = [e for e in self._epochs if since_s <= e.time_s < epoch.time_s]
        return [*[e for e in before if e.layout == epoch.layout], epoch]

    def is_open(self) -> bool:
        """Tell whether the next epoch may still revise the track."""
        elapsed_s = self._epochs[-1].time_s - self._epochs[self._first].time_s
        return self._ballot.is_open(elapsed_s)


def _wrong(votes: list[Vote]) -> tuple[Mask, int]:
    """Return the votes (n,), less than half, that are most likely wrong, and the index of the walk.

    Only some of the first votes may be wrong.
    """
    choices = (np.arange(1 << VOTES)[:, None] >> np.arange(len(votes))) % 2 == 1
    choices = choices[2 * choices.sum(axis=1) < len(votes)]
    errors = _errors(votes, choices)
    best, walk = np.unravel_index(np.argmin(errors), errors.shape)
    return choices[best], int(walk)


def _motion(votes: list[Vote], wrong: Mask, walk: int, time_s: float) -> tuple[Array, Array]:
    """Return the most likely motion: position and velocity (6,) at a time, covariance (6, 6).

    The time is not later than the first vote.
    """
    t, positions, covariances = _arrays(votes)
    S = _covariance(t, covariances, wrong, _WALKS[walk])
    now = time_s - votes[0].time_s
    across = np.vstack(
        [np.kron(now * t, _VELOCITY) + np.tile(_POSITION, len(t)), np.kron(t, _VELOCITY)]
    )
    own = np.block(
        [[_POSITION + now**2 * _VELOCITY, now * _VELOCITY], [now * _VELOCITY, _VELOCITY]]
    )
    mean = across @ np.linalg.solve(S, positions)
    mean[:3] += votes[0].position
    return mean, own - across @ np.linalg.solve(S, across.T)


def _arrays(votes: list[Vote]) -> tuple[Array, Array, Array]:
    """Return times (n,) and positions (3 n,), relative to the first, and covariances (n, 3, 3)."""
    _, times, positions, covariances, _ = zip(*votes, strict=True)
    away = np.array(positions) - positions[0]
    return np.array(times) - times[0], away.ravel(), np.array(covariances)


def _errors(votes: list[Vote], choices: Mask | None = None) -> Array:
    """Return -2 times the log-likelihoods (choices, walks) of votes, up to a constant per vote.

    ``choices`` is a mask (choices, n) of wrong votes; None if none is wrong.
    """
    if choices is None:
        choices = np.zeros((1, len(votes)), np.bool_)
    return _log_likelihoods(*_arrays(votes), choices)  # type: ignore[no-any-return]


@register_jitable  # type: ignore[untyped-decorator]
def _covariance(time_s, covariance, wrong, walk):  # type: ignore[no-untyped-def]
    """Return the covariance (3 n, 3 n) of the positions of n votes (:func:`_arrays`).

    The user moves from an unknown position with an unknown velocity, which a random walk changes
    from the first vote on. A wrong vote is anywhere around the user. ``wrong`` is a mask (n,).
    """
    n = len(time_s)
    S = np.zeros((3 * n, 3 * n))
    for i in range(n):
        for j in range(n):
            earlier = min(time_s[i], time_s[j])
            later = max(time_s[i], time_s[j])
            walked = walk**2 * earlier**2 * (3.0 * later - earlier) / 6.0
            for axis in range(3):
                steady = _POSITION[axis, axis] + _VELOCITY[axis, axis] * earlier * later
                S[3 * i + axis, 3 * j + axis] = steady + (walked if axis < 2 else 0.0)
        for row in range(3):
            for column in range(3):
                S[3 * i + row, 3 * i + column] += covariance[i, row, column]
            S[3 * i + row, 3 * i + row] += wrong[i] * _WRONG_M**2
    return S


@register_jitable  # type: ignore[untyped-decorator]
def _nis_and_log_determinant(S, z):  # type: ignore[no-untyped-def]
    """Return z' S^-1 z + log det S, given S (n, n) and z (n,); S becomes its Cholesky factor."""
    y = np.empty(len(z))
    total = 0.0
    for i in range(len(z)):
        y[i] = z[i]
        for j in range(i):
            for k in range(j):
                S[i, j] -= S[i, k] * S[j, k]
            S[i, j] /= S[j, j]
            S[i, i] -= S[i, j] ** 2
            y[i] -= S[i, j] * y[j]
        S[i, i] = np.sqrt(S[i, i])
        y[i] /= S[i, i]
        total += y[i] ** 2 + 2.0 * np.log(S[i, i])
    return total


@compiled
def _log_likelihoods(time_s, positions, covariance, choices):  # type: ignore[no-untyped-def]
    """Return the result of :func:`_errors`, given :func:`_arrays` and a mask (choices, n)."""
    errors = np.empty((len(choices), len(_WALKS)))
    for choice, wrong in enumerate(choices):
        for walk in range(len(_WALKS)):
            S = _covariance(time_s, covariance, wrong, _WALKS[walk])
            error = _nis_and_log_determinant(S, positions)
            errors[choice, walk] = error + _SELDOM * wrong.sum()
    return errors
