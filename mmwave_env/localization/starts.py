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

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.live_log import LiveEpoch, log_from
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M
from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.models.measurement import link_group
from mmwave_env.models.prior import STEEPEST_FIX_RAD, prior_from_fix
from mmwave_env.models.radio import BIAS_SIGMA_M, UNKNOWN_VELOCITY_MPS, Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask

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
_DIRECTIONS = 12
_STARTS_M = (10.0, 40.0, 160.0)
_ROUNDS = 20
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
    solved = _position_at(log, epoch, scene, radio)
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
    log: Log, epoch: int, scene: Scene, radio: Radio
) -> tuple[Array, Array, bool] | None:
    """Return :func:`_solved` for an epoch's links or, if that is None, with earlier ones.

    Also tell whether earlier ones were needed.
    """
    row = log.part(slice(epoch, epoch + 1))
    sigma = deviations_of(row, scene, radio)[0]
    clock = log.layout.clock
    solved = _solved(row.measurement[0], sigma, row.visible[0], scene, clock)
    if solved:
        return *solved, False
    if clock == "free":
        return None  # earlier ranges have another bias
    solved = _solved(*_pooled(log, epoch, scene, radio), scene, clock)
    return (*solved, True) if solved else None


def deviations_of(log: Log, scene: Scene, radio: Radio) -> Array:
    """Return the standard deviations (T, rows): the receiver's own, else the radio's."""
    modelled = radio.sigma(log.snr_db, scene, log.layout)
    return np.where(np.isfinite(log.sigma), log.sigma, modelled)


def _pooled(log: Log, epoch: int, scene: Scene, radio: Radio) -> tuple[Array, Array, Mask]:
    """Return the latest measurement (rows,) of every row in the second before an epoch.

    Also return standard deviations (rows,), which allow for an unknown motion since then, and the
    groups (groups,) that were measured.
    """
    now = log.time_s[epoch]
    first = int(np.searchsorted(log.time_s, now - POOL_S))
    recent = log.part(slice(first, epoch + 1))
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
    cost, position, information = _descended(links, np.array(list(_starts(links))))
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


def _starts(links: _Links) -> Iterator[Array]:
    """Yield positions (3 or 4,) around the nearest anchors, at the height of the streets."""
    turns = np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS, endpoint=False)
    distance, arrival, _, departure = np.where(links.measured > 0.5, links.z, np.nan)
    azimuth = np.where(np.isnan(arrival), departure + np.pi, arrival)
    order = np.lexsort((distance, np.isnan(azimuth)))  # first those with azimuths, then the nearest
    for link in order[:_SEARCHED]:
        directions = turns if np.isnan(azimuth[link]) else [azimuth[link]]
        known = links.synchronized and np.isfinite(distance[link])
        distances = [distance[link]] if known else _STARTS_M
        for radius in distances:
            for turn in directions:
                aside = radius * np.array([np.cos(turn), np.sin(turn)])
                yield np.array([*(links.anchors[:2, link] + aside), *links.center[2:]])


def _normal(links: _Links, positions: Array) -> tuple[Array, Array, Array]:
    """Return, at S positions (S, n), squared errors (S,), -1/2 of their gradients, informations."""
    S, n = positions.shape
    unknown = _UNKNOWN[:n]
    still = [np.zeros((S, 1))] * (STATE_SIZE - 3)
    columns = [positions[:, i, None] for i in range(n)]
    x = [*columns[:3], *still, *columns[3:]]
    group = link_group(x, *(list(part[:, None]) for part in links[:4]))
    shape = (S, links.anchors.shape[1])
    e = np.stack([np.broadcast_to(value, shape) for value in group.innovation], axis=-1)
    w = 1.0 / np.stack([np.broadcast_to(value, shape) for value in group.variance], axis=-1)
    H = np.empty((*shape, 3, n))
    for row, gradient in enumerate(group.jacobian):
        for column, i in enumerate(unknown):
            H[..., row, column] = gradient[i]
    away = links.center - positions
    cost = (w * e * e).sum(axis=(1, 2)) + (links.weight * away * away).sum(axis=1)
    cost += np.broadcast_to(group.spare_nis, shape).sum(axis=1)  # of azimuth differences
    weighted = w[..., None] * H
    gradient = np.einsum("slrn,slr->sn", weighted, e) + links.weight * away
    information = np.einsum("slrn,slrm->snm", weighted, H) + np.diag(links.weight)
    return cost, gradient, information


def _descended(links: _Links, position: Array) -> tuple[Array, Array, Array]:
    """Find minima near S positions (S, n) by Levenberg-Marquardt; return them as _normal does."""
    cost, gradient, information = _normal(links, position)
    damping = np.full(len(position), 1e-4)
    for _ in range(_ROUNDS):
        scale = np.einsum("snn->sn", information)[:, None] * np.eye(position.shape[1])
        step = np.linalg.solve(information + damping[:, None, None] * scale, gradient[..., None])
        new = position + step[..., 0]
        after = _normal(links, new)
        better = after[0] <= cost
        settled = better & (cost - after[0] < 1e-6)
        position = np.where(better[:, None], new, position)
        gradient = np.where(better[:, None], after[1], gradient)
        information = np.where(better[:, None, None], after[2], information)
        cost = np.where(better, after[0], cost)
        damping = np.where(better, damping / 10.0, damping * 10.0)
        if settled.all():
            break
    return cost, position, information


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

    def add(self, log: Log, epoch: int) -> bool:
        """Let an epoch of a log vote, unless it follows another vote at once; tell if it did."""
        now = float(log.time_s[epoch])
        if not self.is_due(now):
            return False
        solved = _position_at(log, epoch, self._scene, self._radio)
        if solved is None:
            return False
        position, covariance, pooled = solved
        self._votes.append(Vote(epoch, now, position[:3], covariance[:3, :3], pooled))
        return True

    def jump(self) -> int | None:
        """Return the epoch, not one of the first, at which another motion begins, or None."""
        jump = self._jump()
        return None if jump is None else self._votes[jump].epoch

    def _jump(self) -> int | None:
        """Return the index of the vote of the first jump that the next vote confirms, or None."""
        votes = self._votes
        jump = None
        most = _JUMP_ERROR
        for first in range(VOTES, len(votes) - _JUMP + 1):
            before = votes[first - _JUMP : first]
            after = votes[first : first + _JUMP]
            gain = _errors(before + after).min() - _errors(before).min() - _errors(after).min()
            if gain > most:
                most = gain
                jump = first
            elif jump is not None:
                return jump
        return None

    def start(self, log: Log, first: int) -> Start | None:
        """Return the start at an epoch on which a majority agrees.

        The result is None if all votes agree, or if there are too few.
        """
        if len(self._votes) < VOTES:
            return None
        votes = self._votes[: min(VOTES + _JUMP, self._jump() or len(self._votes))]
        mean, covariance, wrong = _majority(votes, float(log.time_s[first]))
        if not wrong:
            return None
        right = next(vote for i, vote in enumerate(votes) if i not in wrong)
        usual = start_at(log, right.epoch, self._scene, self._radio)
        if usual is None:
            return None
        x, P = (part.copy() for part in usual.prior)
        horizontal = [0, 1, 3, 4]
        among = np.ix_(horizontal, horizontal)
        x[horizontal] = mean[horizontal]
        P[horizontal] = 0.0
        P[:, horizontal] = 0.0
        P[among] = _CAUTION * covariance[among]
        contradicting = [votes[i].epoch - first for i in wrong]
        spent = np.zeros((1 + max(contradicting), len(log.layout.groups)), np.bool_)
        spent[contradicting] = True
        return Start((x, P), spent)


class Doubt:
    """The epochs since a start or a gap, whose votes may revise a track that is under way.

    The epochs arrive one by one; the result is the same as that of ``segments.py``, which knows
    all epochs of a log.

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

    def begin(self, epoch: LiveEpoch) -> tuple[Log, Start] | None:
        """Return an epoch (T = 1), and a start with it and the second before it; or None."""
        kept = [e for e in self._epochs if epoch.time_s - POOL_S <= e.time_s < epoch.time_s]
        self._epochs = [e for e in kept if e.layout == epoch.layout] + [epoch]
        self._first = len(self._epochs) - 1
        log = log_from(self._epochs)
        start = start_at(log, self._first, self._scene, self._radio)
        if start is None:
            return None
        self._ballot.add(log, self._first)
        return log.part(slice(self._first, None)), start

    def revise(self, epoch: LiveEpoch) -> tuple[Log, Start] | None:
        """Return the epochs with which to begin again, and their start; None if the track stands.

        ``epoch`` is the next epoch, the last one of the epochs that are returned.
        """
        self._epochs.append(epoch)
        if not self._ballot.is_due(epoch.time_s):
            return None
        log = log_from(self._epochs)
        if not self._ballot.add(log, len(log) - 1):
            return None
        jump = self._ballot.jump()
        if jump is not None:
            self._first = jump
            self._ballot = Ballot(self._scene, self._radio)
            for later in range(jump, len(log)):
                self._ballot.add(log, later)
        elif not self._ballot.is_undecided:
            return None
        start = self._ballot.start(log, self._first)
        revised = start is not None
        if start is None and (self._revised or jump is not None):
            start = start_at(log, self._first, self._scene, self._radio)
        self._revised = revised
        return (log.part(slice(self._first, None)), start) if start else None

    def is_open(self) -> bool:
        """Tell whether the next epoch may still revise the track."""
        elapsed_s = self._epochs[-1].time_s - self._epochs[self._first].time_s
        return self._ballot.is_open(elapsed_s)


def _majority(votes: list[Vote], time_s: float) -> tuple[Array, Array, tuple[int, ...]]:
    """Return the most likely motion, and the indices of the votes, less than half, that are wrong.

    Only some of the first votes may be wrong. The motion is the position and the velocity (6,) at a
    time, which is not later than the first vote, and their covariance (6, 6).
    """
    most = min(VOTES, (len(votes) - 1) // 2)
    counts = range(most + 1)
    choices = [wrong for count in counts for wrong in combinations(range(VOTES), count)]
    errors = _errors(votes, choices)
    best, walk = np.unravel_index(np.argmin(errors), errors.shape)
    S = _covariances(votes, choices[best])[walk]
    t = np.array([vote.time_s for vote in votes]) - votes[0].time_s
    now = time_s - votes[0].time_s
    across = np.vstack(
        [np.kron(now * t, _VELOCITY) + np.tile(_POSITION, len(t)), np.kron(t, _VELOCITY)]
    )
    own = np.block(
        [[_POSITION + now**2 * _VELOCITY, now * _VELOCITY], [now * _VELOCITY, _VELOCITY]]
    )
    mean = across @ np.linalg.solve(S, _positions(votes))
    mean[:3] += votes[0].position
    return mean, own - across @ np.linalg.solve(S, across.T), choices[best]


def _errors(votes: list[Vote], choices: Sequence[tuple[int, ...]] = ((),)) -> Array:
    """Return -2 times the log-likelihoods (choices, walks) of votes, up to a constant per vote.

    Each choice lists the indices of wrong votes.
    """
    S = np.array([_covariances(votes, wrong) for wrong in choices])
    z = _positions(votes)
    nis = np.linalg.solve(S, z[:, None])[..., 0] @ z
    seldom = _SELDOM * np.array([[len(wrong)] for wrong in choices])
    return nis + np.linalg.slogdet(S)[1] + seldom  # type: ignore[no-any-return]


def _positions(votes: list[Vote]) -> Array:
    """Return the positions (3 n,) of votes, relative to the first one."""
    return np.concatenate([vote.position - votes[0].position for vote in votes])


def _covariances(votes: list[Vote], wrong: Sequence[int] = ()) -> Array:
    """Return the covariances (walks, 3 n, 3 n) of the votes' positions.

    The user moves from an unknown position with an unknown velocity, which a random walk changes
    from the first vote on. A wrong vote is anywhere around the user.
    """
    n = len(votes)
    t = np.array([vote.time_s for vote in votes]) - votes[0].time_s
    earlier = np.minimum.outer(t, t)
    walked = earlier**2 * (3.0 * np.maximum.outer(t, t) - earlier) / 6.0
    walks = np.square(_WALKS)[:, None, None]
    S = np.zeros((len(_WALKS), n, 3, n, 3))
    for axis in range(3):
        steady = _POSITION[axis, axis] + _VELOCITY[axis, axis] * np.outer(t, t)
        S[:, :, axis, :, axis] = steady + (walks * walked if axis < 2 else 0.0)
    for i, vote in enumerate(votes):
        S[:, i, :, i, :] += vote.covariance + (i in wrong) * _WRONG_M**2 * np.eye(3)
    return S.reshape(len(_WALKS), 3 * n, 3 * n)
