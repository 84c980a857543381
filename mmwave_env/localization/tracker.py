"""Live localization: a position for every epoch as soon as its rows have arrived."""

import itertools
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from math import inf, isnan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.interface.policy import Switching
from mmwave_env.localization.levels import Levels, LevelState
from mmwave_env.localization.localizer import Filtered, Localizer
from mmwave_env.localization.map_files import geodetic
from mmwave_env.localization.position_errors import gaussian_levels
from mmwave_env.localization.segments import DOUBTFUL_GAP_S
from mmwave_env.localization.starts import Doubt, Start, deviations_of
from mmwave_env.logs.live_log import LiveEpoch, LiveLog, log_from
from mmwave_env.logs.log import Log
from mmwave_env.models.layout import Layout, require_clock
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import SNR_LIMITS_DB, Radio, deviations, radio_from
from mmwave_env.models.scene import Scene, scene_from
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Index, Mask
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import (
    NEUTRAL_SNR_DB,
    EpisodeBatch,
    blank_incoming,
    columns_of,
    sigma_bounds,
)

MOST_USERS = 1 << 14
_POSITION_ROWS: Index = np.array(unpack([*range(6)]))  # (3, 3) indices in a packed covariance
_MANY = 24  # epochs that are faster to convert together than one by one
_TIME_AHEAD_S = 1.0  # by which an epoch may be ahead of all users


class Position(NamedTuple):
    """The belief after an epoch.

    Attributes:
        time_s: time of the epoch.
        position_m: (3,) position in the frame of the scene.
        covariance_m2: (3, 3) covariance of the position.
        velocity_mps: (3,) velocity in the frame of the scene.
        mode: name of the mode that ran or, in a bank, of the most probable mode.
        nis: NIS of each group of values (such as a link) that was measured, by the group's name.
        rejected: names of the groups that the gates rejected.
        begins: whether a track begins here, with a first position from the links.
        geodetic: latitude and longitude (degrees) and height (m); None in a scene without origin.
        clock_m, clock_sigma_m: range bias of the user's clock and its standard deviation; None
            if clocks are synchronized.
        trusted: factor, 0 to 1, that scaled the belief's correction; None without a correction.
        levels_m: horizontal and vertical protection level; None if they are not computed.
    """

    time_s: float
    position_m: list[float]
    covariance_m2: list[list[float]]
    velocity_mps: list[float]
    mode: str
    nis: dict[str, float]
    rejected: list[str]
    begins: bool
    geodetic: list[float] | None
    clock_m: float | None = None
    clock_sigma_m: float | None = None
    trusted: float | None = None
    levels_m: list[float] | None = None


class Tracker:
    """A live tracker of one user; ``localize`` computes bit-identical filtered tracks from logs.

    Only ``localize`` knows from the beginning what the first epochs say together: where these
    contradict a start, a live track is different until it takes the start back
    (:mod:`mmwave_env.localization.starts`), some epochs later.

    ```python
    >>> tracker = Tracker("street", policy=policies.load("corrector"))
    >>> rows = [{"time_s": 0.0, "anchor": 1, "range_m": 71.2, "aoa_azimuth_deg": -45.1,
    ...          "aoa_elevation_deg": -6.9, "aod_azimuth_deg": 134.8, "snr_db": 22.0}]
    >>> tracker.update(rows).position_m  # doctest: +SKIP

    ```

    Args:
        scene: scene whose anchors are measured: a name, a JSON file or a Scene.
        policy: the modes, and the rule or policy that chooses between them.
        radio: profile of the receiver.
        snr_db: SNR to assume for links without an SNR.
        height_m: height of flat terrain, if it is known.
        lag: number of epochs by which :meth:`smoothed` lags behind.
        clock: state of the user's clock, one of :data:`~mmwave_env.models.layout.CLOCKS`.
        levels: protection levels to compute; None to compute none.
        correlation_s: time for which errors of measurements last; 0 if they are independent.
    """

    def __init__(
        self,
        scene: str | Path | Scene,
        policy: Switching,
        radio: str | Path | Radio = "handset",
        snr_db: float | None = None,
        height_m: float | None = None,
        lag: int = 10,
        clock: str = "synchronized",
        levels: Levels | None = None,
        correlation_s: float = 0.0,
    ) -> None:
        self._levels = levels
        self._correlation_s = correlation_s
        require_clock(clock)
        self._clock = clock
        self._scene = scene_from(scene)
        self._radio = radio_from(radio)
        self._switching = policy
        self._snr_db = snr_db
        self._height_m = height_m
        self._log: LiveLog | None = None
        self._filter: Any = None
        self._last_s: float | None = None  # time of the last measurement; None without a track
        self._doubt: Doubt | None = None  # epochs that may still revise the track
        # for each of the last epochs: time; Doppler spread; mode; factors (1, 2) by which Gaussian
        # levels are multiplied; the smoother's input, arrays (1, values)
        self._late: deque[tuple[float, float, str, Array | None, tuple[Array, ...]]]
        self._late = deque(maxlen=lag + 1)

    def update(self, rows: Iterable[Mapping[str, Any]]) -> Position | None:
        """Process the rows of an epoch; return the belief after it.

        Args:
            rows: mappings, one per anchor, whose keys are names of columns (docs/data.md). If a
                value was not measured, it is None or its key is missing.

        Returns:
            The belief. It is None before the first epoch that determines a position, and after a
            long gap until the next such epoch.

        Raises:
            LogError: a row is damaged, or its time is not later than the previous epoch's. All rows
                of the call are ignored, so the caller may repair the row and pass all rows again.
        """
        position = None
        for epoch in self._arrived(rows):
            position = self.step(epoch)
        return position

    def _arrived(self, rows: Iterable[Mapping[str, Any]]) -> list[LiveEpoch]:
        """Return the epochs that rows form."""
        rows = list(rows)
        if not rows:
            return []
        if self._log is None:
            names = dict.fromkeys(name for row in rows for name in row)
            self._log = LiveLog(list(names), self._scene, self._snr_db, clock=self._clock)
        epochs = self._log.add_epoch(rows)
        for warning in self._log.warnings:
            warnings.warn(warning, stacklevel=3)
        self._log.warnings.clear()
        return epochs

    def step(self, epoch: LiveEpoch) -> Position | None:
        """Process an epoch of a live log, as :meth:`update` does."""
        revised = self._revised(epoch, epoch.log)
        if revised:
            return self._restart(*revised)
        if self._last_s is None:
            return None
        row, visible, spread_hz = self._incoming(epoch)
        self._filter.load_epoch([row], epoch.time_s - self._late[-1][0])
        return self._filtered([epoch.time_s], [visible], [spread_hz])

    def _revised(self, epoch: LiveEpoch, row: Callable[[], Log]) -> tuple[Log, Start] | None:
        """Return the epochs with which a track begins, or begins anew, and the start; else None.

        ``row`` returns the epoch as a log (T = 1).
        """
        if self._filter is not None and epoch.layout != self._layout:
            self._filter = None
            self._last_s = None
            self._doubt = None
        gap_s = inf if self._last_s is None else epoch.time_s - self._last_s
        if gap_s > GAP_S or gap_s <= 0.0:  # a clock that was set back begins a new track, too
            if self._last_s is not None or self._doubt is None:
                self._doubt = Doubt(self._scene, self._radio)
                self._last_s = None
            return self._doubt.begin(epoch, row)
        if gap_s > DOUBTFUL_GAP_S:
            self._doubt = Doubt(self._scene, self._radio)
        if self._doubt is None:
            return None
        revised = self._doubt.revise(epoch, row)
        if not self._doubt.is_open():
            self._doubt = None
        return revised

    def _restart(self, log: Log, start: Start) -> Position:
        """Begin a track with the first of T epochs; return the belief after the last one."""
        if self._filter is None:
            self._prepare(log.layout)
        visible = self._localizer.load(log, start)
        times = log.time_s.tolist()
        self._last_s = times[0]
        return self._filtered(times, visible.tolist(), log.doppler_spread_hz.tolist(), begins=True)

    def _filtered(
        self,
        time_s: list[float],
        visible: list[list[bool]],
        spread_hz: list[float],
        begins: bool = False,
    ) -> Position:
        """Filter the loaded epochs; return the belief after the last one."""
        filtered = self._localizer.run()
        factors = self._localizer.level_factors(filtered, visible, time_s, begins)
        if begins:
            self._late.clear()
        for t, groups in enumerate(visible):
            if self._measures(groups):
                self._last_s = time_s[t]
            own = None if factors is None else factors[t : t + 1]
            kept = tuple(part[t : t + 1] for part in filtered.kept)
            mode = self._names[int(filtered.mode[t])]
            self._late.append((time_s[t], spread_hz[t], mode, own, kept))
        levels = self._levels_m(filtered.P, factors)
        return self._reported(filtered, time_s, visible, levels, begins)[-1]

    def _levels_m(self, P: Array, factors: Array | None) -> Array | None:
        """Return protection levels (n, 2) from covariances (n, ...) and factors (n, 2)."""
        if self._levels is None or factors is None:
            return None
        return gaussian_levels(P, self._levels.risk) * factors

    def _measures(self, visible: list[bool]) -> bool:
        """Tell whether an epoch measured a link or odometry."""
        return any(visible[: self._layout.anchors]) or (self._layout.odometry and visible[-1])

    def _reported(
        self,
        filtered: Filtered,
        time_s: list[float],
        visible: list[list[bool]],
        levels_m: Array | None,
        begins: bool = False,
    ) -> list[Position]:
        """Return the beliefs after n filtered epochs, with what happened in them."""
        n = len(time_s)
        trusted = filtered.trusted
        modes = [self._names[mode] for mode in filtered.mode.astype(int).tolist()]
        positions = self._positions(time_s, filtered.x, filtered.P, modes)
        happened = (
            visible,
            filtered.nis.tolist(),
            filtered.accepted.tolist(),
            [None] * n if levels_m is None else levels_m.tolist(),
            [None] * n if trusted is None else trusted.tolist(),
        )
        reported = []
        for position, groups, nis, accepted, level_m, trust in zip(
            positions, *happened, strict=True
        ):
            measured = [g for g, is_seen in enumerate(groups) if is_seen]
            own = position._replace(
                levels_m=level_m,
                nis={self._groups[g]: nis[g] for g in measured},
                rejected=[self._groups[g] for g in measured if accepted[g] < 0.5],
                begins=begins,
                trusted=trust,
            )
            reported.append(own)
        return reported

    def _prepare(self, layout: Layout) -> None:
        """Create the filter and everything else that all epochs share."""
        self._localizer = Localizer(
            layout, self._scene, self._radio, self._switching, self._height_m, self._levels,
            self._correlation_s,
        )  # fmt: skip
        self._filter = self._localizer.engine
        self._layout = layout
        self._groups = layout.group_names
        self._names = self._switching.names
        self._variances = self._radio.variances(self._scene, layout)
        self._at = columns_of(layout)
        self._blank = flatten(blank_incoming(layout))
        self._group_of = np.repeat(np.arange(len(layout.groups)), layout.widths).tolist()
        ends = np.repeat(np.array([SNR_LIMITS_DB]).T, layout.anchors, axis=1)
        sigma = self._radio.sigma(ends, self._scene, layout)
        self._sound = all(bound.holds(sigma[:, rows]).all() for rows, bound in sigma_bounds(layout))

    def _incoming(self, epoch: LiveEpoch) -> tuple[Any, list[bool], float]:
        """Return an epoch's row of a table, its visible groups, and the Doppler spread, Hz."""
        quick = self._quick_incoming(epoch)
        if quick:
            return quick
        log = epoch.log()
        episode = self._localizer.episode(log)
        row = EpisodeBatch.of([episode]).table[0, 0]
        return row, episode.visible[0].tolist(), float(log.doppler_spread_hz[0])

    def _quick_incoming(self, epoch: LiveEpoch) -> tuple[list[float], list[bool], float] | None:
        """Return the same as :meth:`_incoming`, but faster; None if this is impossible."""
        placed = epoch.placed() if self._sound else None
        if placed is None:
            return None
        (numbers, doppler_anchor) = placed
        layout = self._layout
        at = self._at
        size = layout.size
        doppler = layout.doppler
        row = self._blank.copy()
        visible = [False] * len(self._groups)
        snr = numbers[2 * size : -1]
        sigma = deviations(*self._variances, snr, layout)
        if doppler_anchor:
            shifted = deviations(*self._variances, [snr[doppler_anchor]] * layout.anchors, layout)
            sigma[doppler] = shifted[doppler]
        for i, group in enumerate(self._group_of):
            if not isnan(numbers[i]):
                own = numbers[size + i]
                link = doppler_anchor if i == doppler else group
                if isnan(own) and i <= doppler and isnan(snr[link]):
                    return None
                row[at.z[i]] = numbers[i]
                row[at.signed_sigma[i]] = sigma[i] if isnan(own) else own
                visible[group] = True
        for link, snr_db in enumerate(snr):
            if visible[link]:
                row[at.snr_db[link]] = NEUTRAL_SNR_DB if isnan(snr_db) else snr_db
            row[at.doppler_of[link]] = float(link == doppler_anchor)
        if not isnan(numbers[-1]):
            row[at.doppler_spread_hz] = numbers[-1]
        return row, visible, row[at.doppler_spread_hz]

    def smoothed(self) -> Position | None:
        """Return the position ``lag`` epochs ago, smoothed with the epochs since then.

        The result is None as long as the track is too short for this.
        """
        if len(self._late) < (self._late.maxlen or 0):
            return None
        times, spreads, modes, factors, kept = zip(*self._late, strict=True)
        late = np.concatenate([np.concatenate(parts, axis=1) for parts in kept])[None]
        x, P = self._localizer.smoothed(late, np.array([times]), np.array([spreads]))
        (position,) = self._positions(times[:1], x[0, :1], P[0, :1], modes[:1])
        levels_m = self._levels_m(P[0, :1], factors[0])
        return position._replace(levels_m=None if levels_m is None else levels_m[0].tolist())

    def _positions(
        self, time_s: Sequence[float], x: Array, P: Array, modes: Sequence[str]
    ) -> list[Position]:
        """Return beliefs (n, ...) without levels and without what happened in their epochs."""
        n = len(time_s)
        origin = self._scene.origin
        columns = (
            time_s,
            x[:, :3].tolist(),
            P[:, _POSITION_ROWS].tolist(),
            x[:, 3:6].tolist(),
            modes,
            [None] * n if origin is None else geodetic(origin, x[:, :3]).tolist(),
            x[:, 7].tolist() if self._layout.has_bias else [None] * n,
            np.sqrt(P[:, 35]).tolist() if self._layout.has_bias else [None] * n,
        )
        return [
            Position(t, position, covariance, velocity, mode, {}, [], False, *rest)
            for t, position, covariance, velocity, mode, *rest in zip(*columns, strict=True)
        ]


@dataclass(slots=True)
class _User:
    """The state of a user between two epochs."""

    seen_s: float = 0.0  # time of all users together when the user's last epoch arrived
    last_s: float | None = None  # as in a Tracker
    doubt: Doubt | None = None
    end_s: float = 0.0  # time of the last filtered epoch
    state: Array = field(default_factory=lambda: np.empty(0))  # (size,) state of the filter
    memory: Sequence[Array] = ()  # the policy's, arrays (1, ...)
    levels: Sequence[Array] = ()  # of a LevelState


class Trackers:
    """Live trackers of many users, whose epochs are filtered together.

    Each user's positions are, to the bit, those of a :class:`Tracker` of its own. Users come and
    go: whoever is silent for longer than a track can last is forgotten, and whoever has been silent
    longest if there are more than ``MOST_USERS``. A policy's memory must be in its ``memory``.

    ```python
    >>> trackers = Trackers(Tracker("street", policy=policies.load("corrector")))
    >>> rows = [{"ue": "a", "time_s": 0.0, "anchor": 1, "range_m": 71.2, "aoa_azimuth_deg": -45.1,
    ...          "aoa_elevation_deg": -6.9, "aod_azimuth_deg": 134.8, "snr_db": 22.0}]
    >>> trackers.update(rows)["a"].position_m  # doctest: +SKIP

    ```

    Args:
        tracker: a tracker of a single user, still without a track; it begins the users' tracks.

    Attributes:
        forgotten: users who have been forgotten; the caller clears it.
    """

    def __init__(self, tracker: Tracker) -> None:
        self.forgotten: list[str] = []
        self._beginner = tracker
        self._users: dict[str, _User] = {}  # in the order of their last epochs
        self._now_s = -inf
        self._engines: dict[int, Any] = {}  # by number of tracks

    def update(self, rows: Iterable[Mapping[str, Any]]) -> dict[str, Position]:
        """Process rows with a key ``ue``, an epoch of each user; return the beliefs by user.

        Arguments and errors are the same as for :meth:`Tracker.update`.
        """
        positions = dict(self.step(self._beginner._arrived(rows)))
        if self._beginner._log:
            self._beginner._log.forget(self.forgotten)
        return positions

    def step(self, epochs: Iterable[LiveEpoch]) -> list[tuple[str, Position]]:
        """Process epochs of live logs; return users, and the beliefs after their epochs."""
        return [done for some in _rounds(epochs) for done in self._step(some)]

    def _step(self, epochs: Sequence[LiveEpoch]) -> list[tuple[str, Position]]:
        """Process an epoch of each of some users, as :func:`_rounds` returns them."""
        tracker = self._beginner
        if tracker._filter is not None and epochs[0].layout != tracker._layout:
            self._users.clear()
            self._engines.clear()
        begun: list[tuple[LiveEpoch, _User]] = []
        starts: list[Start] = []
        going_on: list[tuple[LiveEpoch, _User]] = []
        done = []
        for epoch, row in zip(epochs, self._rows(epochs), strict=True):
            user = self._arrived(epoch)
            tracker._last_s = user.last_s
            tracker._doubt = user.doubt
            revised = tracker._revised(epoch, row)
            if revised and len(revised[0]) == 1:
                begun.append((epoch, user))
                starts.append(revised[1])
            elif revised:
                done.append((epoch.user, tracker._restart(*revised)))
                self._keep([user], [epoch.time_s], tracker._filter)
            elif tracker._last_s is not None:
                going_on.append((epoch, user))
            user.last_s = tracker._last_s
            user.doubt = tracker._doubt
        return [*done, *self._filtered(begun, starts), *self._filtered(going_on)]

    def _rows(self, epochs: Sequence[LiveEpoch]) -> list[Callable[[], Log]]:
        """Return functions that return the epochs as logs (T = 1), for votes alone.

        Filters need other logs, because many epochs get the radio's standard deviations here.
        """
        if len(epochs) < _MANY:
            return [epoch.log for epoch in epochs]

        @cache
        def voting() -> Log:
            tracker = self._beginner
            log = log_from(epochs)
            sigma = deviations_of(log, tracker._scene, tracker._radio)
            return replace(log, sigma=sigma)

        def row(i: int) -> Log:
            return voting().part(slice(i, i + 1))

        return [partial(row, i) for i in range(len(epochs))]

    def smoothed(self) -> None:
        """Return None: users have no smoothed positions."""

    def _arrived(self, epoch: LiveEpoch) -> _User:
        """Return the user of an epoch; forget users who have left."""
        if not self._users:
            self._now_s = epoch.time_s
        user = self._users.pop(epoch.user, None) or _User()
        # A wrong time far ahead of the others is no reason to forget all of them.
        self._now_s = max(self._now_s, min(epoch.time_s, self._now_s + _TIME_AHEAD_S))
        user.seen_s = self._now_s
        self._users[epoch.user] = user
        for name, other in [*itertools.islice(self._users.items(), 2)]:
            if self._now_s - other.seen_s > GAP_S or len(self._users) > MOST_USERS:
                del self._users[name]
                self.forgotten.append(name)
        return user

    def _filtered(
        self, ready: Sequence[tuple[LiveEpoch, _User]], starts: Sequence[Start] = ()
    ) -> Iterator[tuple[str, Position]]:
        """Filter an epoch of each of some users; tracks begin if there are ``starts``."""
        if not ready:
            return
        epochs, users = zip(*ready, strict=True)
        tracker = self._beginner
        if tracker._filter is None:
            tracker._prepare(epochs[0].layout)
        localizer = tracker._localizer
        levels = localizer.levels
        count = len(users)
        engine = self._engine(count)
        times = [epoch.time_s for epoch in epochs]
        if starts:
            log = log_from(epochs)
            rows = [log.part(slice(i, i + 1)) for i in range(count)]
            episodes = [localizer.episode(*pair) for pair in zip(rows, starts, strict=True)]
            engine.load(episodes, np.arange(count))
            visible = np.concatenate([episode.visible for episode in episodes])
        else:
            incoming, visible = self._incoming(epochs)
            gaps = np.array(times) - np.array([user.end_s for user in users])
            engine.load_epoch(incoming, gaps)
            engine.write(slice(None), np.array([user.state for user in users]), np.arange(count))
            memory = _joined([user.memory for user in users])
            for part, remembered in zip(engine.memory, memory, strict=True):
                part[:count] = remembered
            if levels and users[0].levels:
                levels.state = LevelState(*_joined([user.levels for user in users]))
        filtered = localizer.run(engine, count)
        factors = localizer.level_factors(filtered, visible, times, bool(starts), tracks=True)
        levels_m = tracker._levels_m(filtered.P, factors)
        self._keep(users, times, engine)
        groups = visible.tolist()
        for user, time_s, measured in zip(users, times, groups, strict=True):
            if starts or tracker._measures(measured):
                user.last_s = time_s
        positions = tracker._reported(filtered, times, groups, levels_m, bool(starts))
        yield from zip([epoch.user for epoch in epochs], positions, strict=True)

    def _engine(self, count: int) -> Any:
        """Return an engine for at least this number of tracks."""
        n = max(8, 1 << (count - 1).bit_length())
        if n not in self._engines:
            self._engines[n] = self._beginner._localizer.tracks(n)
        return self._engines[n]

    def _incoming(self, epochs: Sequence[LiveEpoch]) -> tuple[Array, Mask]:
        """Return the epochs' rows of a table (k, columns), and visible groups (k, groups)."""
        tracker = self._beginner
        if len(epochs) < _MANY:
            rows, visible, _ = zip(*map(tracker._incoming, epochs), strict=True)
            return np.array(rows), np.array(visible)
        log = log_from(epochs)
        # An episode's times must increase; the gaps of users are set later.
        episode = tracker._localizer.episode(replace(log, time_s=np.arange(float(len(log)))))
        return episode.table(), log.visible

    def _keep(self, users: Sequence[_User], times: Sequence[float], engine: Any) -> None:
        """Keep what the next epochs of tracks need; user i has track i of an engine."""
        levels = self._beginner._localizer.levels
        states = engine.read(slice(None))
        for i, (user, time_s) in enumerate(zip(users, times, strict=True)):
            user.end_s = time_s
            user.state = states[i].copy()
            user.memory = _row(engine.memory, i)
            user.levels = _row(levels.state, i) if levels and levels.state else ()


def _rounds(epochs: Iterable[LiveEpoch]) -> Iterator[list[LiveEpoch]]:
    """Divide epochs into lists in which all have the same columns, and different users."""
    some: dict[str, LiveEpoch] = {}
    columns = None
    for epoch in epochs:
        if some and (epoch.user in some or epoch.columns is not columns):
            yield [*some.values()]
            some = {}
        some[epoch.user] = epoch
        columns = epoch.columns
    if some:
        yield [*some.values()]


def _row(arrays: Sequence[Array], row: int) -> list[Array]:
    """Return copies of a row of arrays (n, ...), as arrays (1, ...)."""
    return [part[row : row + 1].copy() for part in arrays]


def _joined(rows: Sequence[Sequence[Array]]) -> list[Array]:
    """Join the rows (1, ...) of n users into arrays (n, ...)."""
    return [np.concatenate(parts) for parts in zip(*rows, strict=True)]
