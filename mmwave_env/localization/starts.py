"""First positions of tracks, from the links of one or several epochs of a log.

A complete link of the base station gives a position directly. Otherwise, the position is computed
from all links of the epoch, by nonlinear least squares with the height of the streets as a weak
prior. Receivers that measure one anchor after the other have one link per epoch; so if an epoch
alone determines no position, the latest links of the second before it help.

The first epochs may be wrong: a receiver that sees the base station only by a reflection measures
a range that is too long, and other angles. So a start is confirmed by *votes*, the positions in
some of the first epochs. If a majority agrees on a straight motion that another vote contradicts,
the track begins from this motion instead. It also does if the first vote is much less sure.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mmwave_env.localization.first_position import (
    FARTHEST_M,
    HEIGHT_SIGMA_M,
    STARTS_M,
    UNKNOWN,
    Fix,
    position_from_links,
)
from mmwave_env.logs.live_log import LiveEpoch, log_from
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M
from mmwave_env.models.prior import STEEPEST_FIX_RAD, prior_from_fix
from mmwave_env.models.radio import UNKNOWN_VELOCITY_MPS, Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask

POOL_S = 1.0  # age up to which earlier links help to determine a first position
VOTES = 5  # positions that confirm a start
# minimum time between votes: between the first ones, between later ones
_SPACING_S = 0.25
_LATER_SPACING_S = POOL_S
_DRIFT_MPS = 10.0  # standard deviation of the drift of a receiver's own clock: 33 ns/s
# The motion between votes: standard deviations of position, velocity and its change in a second
_POSITION = np.diag([FARTHEST_M, FARTHEST_M, HEIGHT_SIGMA_M]) ** 2
_VELOCITY = np.diag([UNKNOWN_VELOCITY_MPS, UNKNOWN_VELOCITY_MPS, 0.5]) ** 2
_WALKS = (0.3, 1.5)
# A vote may be wrong: by this distance (standard deviation per axis), and as seldom as this
# penalty, -2 times the logarithm of a probability of 10 %, says.
_WRONG_M = 5.0
_SELDOM = 4.6
_FAR = 6.0  # squared deviations of a first vote from the motion of all beyond which it misleads
_CAUTION = 4.0  # factor for the covariance of a start from votes, whose links are used again
_DOUBTED_S = 10.0  # time after a start or a long gap in which votes may end a track
_PATIENCE_S = 60.0  # time in which the first votes must come
_JUMP = 3  # votes on each side of a jump
_JUMP_ERROR = 16.0  # minimum reduction of the error by a jump
_RANGE_ROW = np.array([True, False, False, False])  # the range among the rows of a link


class Start(NamedTuple):
    """A state to begin a track with."""

    prior: tuple[Array, Array]  # mean (7,), covariance (7, 7); (8,), (8, 8) with a clock offset
    # (k, groups) which groups of the first k epochs the filters must leave out, because the prior
    # was computed from them, or because they contradict it
    spent: Mask

    def unspent(self, visible: Mask) -> Mask:
        """Return which groups (T, groups) are left of those visible in the first T epochs."""
        left = visible.copy()
        spent = self.spent[: len(left)]
        left[: len(spent)] &= ~spent
        return left


def gives_fix(links: Array) -> Mask:
    """Tell which links (n, 4 or more), in m and rad, determine a position to begin a track with.

    Straight above or below an anchor, the azimuth is undefined. Near the vertical, it is so
    uncertain that a Gaussian does not describe the position.
    """
    return (links[:, 0] >= RANGE_LIMITS_M[0]) & (abs(links[:, 2]) <= STEEPEST_FIX_RAD)


def start_at(log: Log, epoch: int, scene: Scene, radio: Radio, sure: bool = False) -> Start | None:
    """Return a state to begin a track with at an epoch of a log; None if there is none.

    If it must be ``sure``, all links must agree, and have more values than a position needs.
    """
    row = log.part(slice(epoch, epoch + 1))
    link = row.measurement[0, :4]
    spent = np.zeros((1, len(row.layout.groups)), np.bool_)
    whole = np.isfinite(link).all() and row.visible[0, 0] and not row.layout.has_bias
    solved = _position_at(log, epoch, scene, radio)
    if sure and not (solved and solved[0].agree):
        return None
    contradicted = solved is not None and 0 not in solved[0].used
    if whole and gives_fix(row.measurement)[0] and not contradicted:
        spent[0, 0] = True
        sigma = deviations_of(row, scene, radio)[0, :4]
        return Start(prior_from_fix(scene.anchors_m[0], link, sigma, radio, scene), spent)
    links = row.layout.anchors
    if (row.visible_links & (abs(row.links[..., 2]) > STEEPEST_FIX_RAD)).any():
        return None  # near the vertical, filters can't follow
    spent[0, :links] = row.visible[0, :links]
    if solved is None:
        return None
    unknown, covariance, *_ = solved[0]
    n = row.layout.state_size
    x = np.zeros(n)
    P = radio.prior_covariance(scene, row.layout.clock)
    among = UNKNOWN[: len(unknown)]
    x[among] = unknown
    P[np.ix_(among, among)] = covariance
    P[3, 3] = P[4, 4] = radio.start_velocity_mps**2
    if row.layout.clock == "offset":
        P[6, 6] = (_DRIFT_MPS * scene.hz_per_mps) ** 2
    return Start((x, P), spent)


def _position_at(log: Log, epoch: int, scene: Scene, radio: Radio) -> tuple[Fix, bool] | None:
    """Return :func:`position_from_links` of an epoch or, if that is None, with earlier links.

    Also tell whether earlier ones were needed.
    """
    clock = log.layout.clock
    for age_s in (0.0, POOL_S):
        solved = position_from_links(*_latest(log, epoch, age_s, scene, radio), scene, clock)
        if solved:
            return solved, age_s > 0.0
        if clock == "free":
            break  # earlier ranges have another bias
    return None


def deviations_of(log: Log, scene: Scene, radio: Radio) -> Array:
    """Return the standard deviations (T, rows): the receiver's own, else the radio's."""
    return np.where(np.isfinite(log.sigma), log.sigma, radio.sigma(log.snr_db, scene, log.layout))


def _latest(log: Log, epoch: int, age_s: float, scene: Scene, radio: Radio) -> tuple[Array, Array]:
    """Return the links (L, 4) at an epoch: the latest value of each row that is not older.

    Values are NaN where not measured. Also return standard deviations (L, 4), which allow for an
    unknown motion since then.
    """
    now = log.time_s[epoch]
    log = log.part(slice(int(np.searchsorted(log.time_s, now - age_s)), epoch + 1))
    anchors = log.layout.anchors
    z = log.links
    measured = np.isfinite(z) & log.visible[:, :anchors, None]
    distance = np.where(np.isfinite(z[..., :1]), np.maximum(z[..., :1], 1.0), STARTS_M[0])
    moved_m = radio.start_velocity_mps * (now - log.time_s)[:, None, None]
    moved = moved_m / np.where(_RANGE_ROW, 1.0, distance)
    sigma = np.hypot(deviations_of(log, scene, radio)[:, : 4 * anchors].reshape(z.shape), moved)
    last = len(log) - 1 - measured[::-1].argmax(axis=0, keepdims=True)
    latest = np.take_along_axis(np.where(measured, z, np.nan), last, axis=0)[0]
    return latest, np.take_along_axis(sigma, last, axis=0)[0]


class Vote(NamedTuple):
    """A position in one of the first epochs of a track."""

    epoch: int
    time_s: float
    position: Array  # (3,)
    covariance: Array  # (3, 3)
    pooled: bool  # whether links of earlier epochs were needed


@dataclass(eq=False)
class Ballot:
    """The votes in the first seconds of a track, or after a gap.

    Args:
        scene, radio: the scene and the radio of the log.
    """

    _scene: Scene
    _radio: Radio
    _votes: list[Vote] = field(default_factory=list)
    _jump: int | None = None  # index of the first vote of another motion
    # the vote that may become this one, if the next one explains the votes less well; its gain
    _candidate: int | None = None
    _gain: float = _JUMP_ERROR

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

    def vote(self, log: Log, epoch: int, before: int = 0) -> bool:
        """Let an epoch of a log vote, unless it follows another vote at once; tell if it did.

        ``before`` is the number of epochs before the first one of the log.
        """
        time_s = float(log.time_s[epoch])
        solved = _position_at(log, epoch, self._scene, self._radio) if self.is_due(time_s) else None
        if solved is None:
            return False
        fix, pooled = solved
        self._votes.append(
            Vote(before + epoch, time_s, fix.position[:3], fix.covariance[:3, :3], pooled)
        )
        self._look_for_jump()
        return True

    def _look_for_jump(self) -> None:
        """Look whether another motion begins with the third last vote."""
        first = len(self._votes) - _JUMP
        if self._jump is not None or first < VOTES:
            return
        near = self._votes[first - _JUMP :]
        gain = _error(near) - _error(near[:_JUMP]) - _error(near[_JUMP:])
        if gain > self._gain:
            self._gain = gain
            self._candidate = first
        else:
            self._jump = self._candidate

    def jump(self) -> int | None:
        """Return the epoch, not one of the first, at which another motion begins, or None."""
        return None if self._jump is None else self._votes[self._jump].epoch

    def start(self, log: Log, first: int) -> Start | None:
        """Return a start, at an epoch, from the motion of the votes; None if the first one stands.

        The first one is replaced if a majority agrees on a motion that another vote contradicts. A
        first vote that is less sure than the motion, as from links of several epochs, may be far
        from it without contradicting it. But a filter that begins there is linear only near the
        user.
        """
        if len(self._votes) < VOTES:
            return None
        # the votes that decide about the start
        votes = self._votes[: min(VOTES + _JUMP, self._jump or len(self._votes))]
        now = float(log.time_s[first])
        wrong, mean, covariance = _motion(votes, now)
        opening = votes[0]
        away = (mean[:3] + (opening.time_s - now) * mean[3:] - opening.position)[:2]
        misled = away @ np.linalg.solve(opening.covariance[:2, :2], away) > _FAR
        if not (opening.pooled or wrong.any() or misled):
            return None
        right = votes[int(wrong.argmin())]
        usual = start_at(log, right.epoch, self._scene, self._radio)
        if usual is None:
            return None
        x = usual.prior[0].copy()
        P = usual.prior[1].copy()
        horizontal = [0, 1, 3, 4]
        among = np.ix_(horizontal, horizontal)
        x[horizontal] = mean[horizontal]
        P[horizontal] = 0.0
        P[:, horizontal] = 0.0
        P[among] = _CAUTION * covariance[among]
        contradicting = [votes[i].epoch - first for i in np.flatnonzero(wrong)]
        spent = np.zeros((1 + max(contradicting, default=0), len(log.layout.groups)), np.bool_)
        spent[contradicting] = True
        return Start((x, P), spent)


def ballot_of(log: Log, first: int, end: int, scene: Scene, radio: Radio) -> Ballot:
    """Return the votes of the epochs from ``first`` on, before ``end``."""
    ballot = Ballot(scene, radio)
    for epoch in range(first, end):
        if not ballot.is_open(float(log.time_s[epoch] - log.time_s[first])):
            break
        ballot.vote(log, epoch)
    return ballot


class Doubt:
    """The epochs since a start or a gap, whose votes may revise a track that is under way.

    The epochs have one layout and arrive one by one; the result is the same as that of
    ``segments.py``, which knows all epochs of a log.

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
        self._epochs = self._until(epoch)
        self._first = len(self._epochs) - 1
        log = log_from(self._epochs)
        start = start_at(log, self._first, self._scene, self._radio)
        if start is None:
            return None
        self._ballot.vote(log, self._first)
        return log.part(slice(self._first, None)), start

    def revise(self, epoch: LiveEpoch) -> tuple[Log, Start] | None:
        """Return the epochs with which to begin again, and their start; None if the track stands.

        ``epoch`` is the next epoch, the last one of the epochs that are returned.
        """
        ballot = self._ballot
        self._epochs.append(epoch)
        if not (self.is_open() and ballot.is_due(epoch.time_s)):
            return None
        recent = self._until(epoch)
        before = len(self._epochs) - len(recent)
        if not ballot.vote(log_from(recent), len(recent) - 1, before):
            return None
        jump = ballot.jump()
        if jump is None and not ballot.is_undecided:
            return None
        log = log_from(self._epochs)
        if jump is not None:
            self._first = jump
            self._ballot = ballot_of(log, jump, len(log), self._scene, self._radio)
        start = self._ballot.start(log, self._first)
        revised = start is not None
        if not revised and (self._revised or jump is not None):
            start = start_at(log, self._first, self._scene, self._radio)
        self._revised = revised
        return (log.part(slice(self._first, None)), start) if start else None

    def _until(self, epoch: LiveEpoch) -> list[LiveEpoch]:
        """Return the epochs of the second before an epoch, and this epoch."""
        since_s = epoch.time_s - POOL_S
        return [*[e for e in self._epochs if since_s <= e.time_s < epoch.time_s], epoch]

    def is_open(self) -> bool:
        """Tell whether the last epoch, or a later one, may still revise the track."""
        elapsed_s = self._epochs[-1].time_s - self._epochs[self._first].time_s
        return self._ballot.is_open(elapsed_s)


def _motion(votes: list[Vote], time_s: float) -> tuple[Mask, Array, Array]:
    """Return the most likely motion of votes (n,): position and velocity (6,) at a time.

    The time is not later than the first vote. Also return which votes (n,) are most likely wrong,
    less than half and only some of the first; and the covariance (6, 6).
    """
    choices = (np.arange(1 << VOTES)[:, None] >> np.arange(len(votes))) % 2 == 1
    choices = choices[2 * choices.sum(axis=1) < len(votes)]
    covariances, errors = _likelihoods(votes, choices)
    best = np.unravel_index(np.argmin(errors), errors.shape)
    t, away = _relative(votes)
    now = time_s - votes[0].time_s
    across = np.vstack(
        [np.kron(now * t, _VELOCITY) + np.tile(_POSITION, len(t)), np.kron(t, _VELOCITY)]
    )
    own = np.block(
        [[_POSITION + now**2 * _VELOCITY, now * _VELOCITY], [now * _VELOCITY, _VELOCITY]]
    )
    S = covariances[best]
    mean = across @ np.linalg.solve(S, away)
    mean[:3] += votes[0].position
    return choices[best[0]], mean, own - across @ np.linalg.solve(S, across.T)


def _relative(votes: list[Vote]) -> tuple[Array, Array]:
    """Return times (n,) and positions (3 n,) of votes, relative to the first."""
    times = np.array([vote.time_s for vote in votes])
    positions = np.array([vote.position for vote in votes])
    return times - times[0], (positions - positions[0]).ravel()


def _error(votes: list[Vote]) -> float:
    """Return the smallest error of :func:`_likelihoods` if none of the votes is wrong."""
    _, errors = _likelihoods(votes, np.zeros((1, len(votes)), np.bool_))
    return float(errors.min())


def _likelihoods(votes: list[Vote], choices: Mask) -> tuple[Array, Array]:
    """Return the covariances of n votes, and -2 times their log-likelihoods up to a constant.

    The user moves from an unknown position with an unknown velocity, which a random walk changes
    from the first vote on. A wrong vote is anywhere around the user.

    Args:
        votes: the votes.
        choices: (choices, n) which votes are wrong.

    Returns:
        Covariances (choices, walks, 3 n, 3 n) and errors (choices, walks).
    """
    n = len(votes)
    t, away = _relative(votes)
    earlier = np.minimum.outer(t, t)
    later = np.maximum.outer(t, t)
    walked = np.square(_WALKS)[:, None, None] * earlier**2 * (3.0 * later - earlier) / 6.0
    velocity = np.kron(earlier, _VELOCITY) * np.kron(later, np.ones((3, 3)))
    S = np.tile(_POSITION, (n, n)) + velocity + np.kron(walked, np.diag([1.0, 1.0, 0.0]))
    each = np.arange(n)
    covariances = np.array([vote.covariance for vote in votes])
    S.reshape(-1, n, 3, n, 3)[:, each, :, each] += covariances[:, None]
    S = S + _WRONG_M**2 * np.repeat(choices, 3, axis=1)[:, None, None] * np.eye(3 * n)
    nis = np.linalg.solve(S, away[:, None])[..., 0] @ away
    seldom = _SELDOM * choices.sum(axis=1, keepdims=True)
    return S, nis + np.linalg.slogdet(S).logabsdet + seldom
