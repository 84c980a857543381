"""Live localization: a position for every epoch as soon as its rows have arrived."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import compress, islice
from math import inf, isnan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.interface.policy import Switching
from mmwave_env.localization.levels import GAUSSIAN_LEVELS, Levels
from mmwave_env.localization.localizer import Localizer, episode_from
from mmwave_env.localization.map_files import geodetic
from mmwave_env.localization.position_errors import gaussian_levels
from mmwave_env.localization.segments import DOUBTFUL_GAP_S, begun_again, is_lost
from mmwave_env.localization.starts import Doubt, Start, start_at
from mmwave_env.logs.live_log import LiveEpoch, LiveLog, Row, log_from
from mmwave_env.logs.log import Log
from mmwave_env.models.layout import Layout, require_clock
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio, deviations, radio_from
from mmwave_env.models.scene import Scene, scene_from
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import NEUTRAL_SNR_DB, blank_incoming, columns_of

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


@dataclass(slots=True, eq=False)
class _User:
    """The state of a user between two epochs."""

    seen_s: float = 0.0  # time of all users together when the user's last epoch arrived
    last_s: float = -inf  # time of the last measurement; -inf without a track
    doubt: Doubt | None = None  # epochs that may still revise the track
    end_s: float = 0.0  # time of the last filtered epoch
    # of a track in no engine: arrays (1, ...) of the filter, the memories of a policy and of levels
    track: Sequence[NDArray[Any]] = ()


class Tracker:
    """A live tracker of users; ``localize`` computes bit-identical filtered tracks from logs.

    Many users are filtered together, with the results of trackers of their own; a policy's memory
    must be in its ``memory``. Tracks stay in an engine as long as the epochs of the same users
    arrive together. Users come and go: whoever is silent for longer than a track can last is
    forgotten, and whoever has been silent longest if there are more than ``MOST_USERS``.

    Only ``localize`` knows from the beginning what the first epochs say together: where these
    contradict a start, a live track is different until it takes the start back
    (:mod:`mmwave_env.localization.starts`), some epochs later.

    ```python
    >>> import policies
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
        clock: state of the user's clock, one of :data:`~mmwave_env.models.layout.CLOCKS`.
        levels: protection levels to compute; None to compute none.
        correlation_s: time for which errors of measurements last; 0 if they are independent.

    Attributes:
        radio: profile of the receiver.
        forgotten: users who have been forgotten; :meth:`step`'s caller clears it.
    """

    def __init__(
        self,
        scene: str | Path | Scene,
        policy: Switching,
        radio: str | Path | Radio = "handset",
        snr_db: float | None = None,
        height_m: float | None = None,
        clock: str = "synchronized",
        levels: Levels | None = None,
        correlation_s: float = 0.0,
    ) -> None:
        require_clock(clock)
        self.forgotten: list[str] = []
        self._levels = levels
        self._correlation_s = correlation_s
        self._scene = scene_from(scene)
        self.radio = radio_from(radio)
        self._switching = policy
        self._height_m = height_m
        self._log = LiveLog([], self._scene, snr_db, clock=clock)
        self._layout: Layout | None = None  # of the latest epochs
        self._users: dict[str, _User] = {}  # in the order of their last epochs
        self._now_s = -inf

    def update(self, rows: Iterable[Row]) -> Position | None:
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
        positions = [position for _, position in self.step(self.arrived(rows))]
        return positions[-1] if positions else None

    def update_users(self, rows: Iterable[Row]) -> dict[str, Position]:
        """Process rows with a key ``ue``, an epoch of each user; return the beliefs by user.

        Arguments and errors are the same as for :meth:`update`.
        """
        return dict(self.step(self.arrived(rows)))

    def arrived(self, rows: Iterable[Row]) -> list[LiveEpoch]:
        """Return the epochs that rows form; :meth:`update` describes arguments and errors."""
        rows = list(rows)
        if not rows:
            return []
        self._log.forget(self.forgotten)
        epochs = self._log.add_epoch(rows)
        for warning in self._log.warnings:
            warnings.warn(warning, stacklevel=3)
        self._log.warnings.clear()
        return epochs

    def step(self, epochs: Iterable[LiveEpoch]) -> Iterator[tuple[str, Position]]:
        """Process epochs of live logs; yield users ("" if nobody is named), and their beliefs."""
        for some in _rounds(epochs):
            if some[0].layout != self._layout:
                self._prepare(some[0].layout)
            going_on: list[LiveEpoch] = []
            users: list[_User] = []
            for epoch in some:
                user = self._user_of(epoch)
                revised = self._revised(user, epoch)
                if revised:
                    yield epoch.user, self._restarted(user, *revised)
                elif user.last_s > -inf:
                    going_on.append(epoch)
                    users.append(user)
            if users:
                positions = self._continued(users, going_on)
                yield from zip([epoch.user for epoch in going_on], positions, strict=True)

    def _prepare(self, layout: Layout) -> None:
        """Create all that the epochs of a layout share; tracks of another layout end."""
        self._localizer = Localizer(
            layout, self._scene, self.radio, self._switching, self._height_m,
            self._levels or GAUSSIAN_LEVELS, self._correlation_s,
        )  # fmt: skip
        self._users.clear()
        self._engines = {1: self._localizer.engine}  # by number of tracks
        self._loaded: list[_User] = []  # users whose tracks are in the engine that ran last
        self._layout = layout
        self._groups = layout.group_names
        self._variances = self.radio.variances(self._scene, layout)
        self._at = columns_of(layout)
        self._blank = flatten(blank_incoming(layout))

    def _user_of(self, epoch: LiveEpoch) -> _User:
        """Return the user of an epoch; forget users who have left."""
        if not self._users:
            self._now_s = epoch.time_s
        user = self._users.pop(epoch.user, None)
        if user is None:
            user = _User()
        # A wrong time far ahead of the others is no reason to forget all of them.
        self._now_s = max(self._now_s, min(epoch.time_s, self._now_s + _TIME_AHEAD_S))
        user.seen_s = self._now_s
        self._users[epoch.user] = user
        for name, other in [*islice(self._users.items(), 2)]:
            if self._now_s - other.seen_s > GAP_S or len(self._users) > MOST_USERS:
                del self._users[name]
                self.forgotten.append(name)
        return user

    def _revised(self, user: _User, epoch: LiveEpoch) -> tuple[Log, Start] | None:
        """Return the epochs with which a track begins, or begins anew, and the start; else None."""
        gap_s = epoch.time_s - user.last_s
        # a clock that was set back begins a new track, too
        if gap_s > GAP_S or epoch.time_s <= user.end_s:
            if user.last_s > -inf or user.doubt is None:
                user.doubt = Doubt(self._scene, self.radio)
                user.last_s = -inf
            return user.doubt.begin(epoch)
        if gap_s > DOUBTFUL_GAP_S:
            user.doubt = Doubt(self._scene, self.radio)
        if user.doubt is None:
            return None
        revised = user.doubt.revise(epoch)
        if not user.doubt.is_open():
            user.doubt = None
        return revised

    def _restarted(self, user: _User, log: Log, start: Start) -> Position:
        """Begin a track with the first of T epochs; return the belief after the last one."""
        self._store()
        self._loaded = [user]
        self._engine = self._engines[1]
        log = replace(log, visible=start.unspent(log.visible))
        self._localizer.load(log, start)
        times = log.time_s.tolist()
        user.last_s = times[0]
        parts = self._localizer.run(self._engine, [times])
        another = begun_again(log, parts["memory.nis"][0], True, self._scene, self.radio)
        if another:
            first, start = another
            return self._restarted(user, log.part(slice(first, None)), start)
        (position,) = self._positions(parts, [times], begins=True)
        return position

    def _continued(self, users: list[_User], epochs: Sequence[LiveEpoch]) -> list[Position]:
        """Filter an epoch of each of k users with tracks; return the beliefs after them."""
        rows = self._incoming(epochs)
        if users != self._loaded:
            self._store()
            self._restore(users)
        for row, epoch, user in zip(rows, epochs, users, strict=True):
            row[self._at.dt] = epoch.time_s - user.end_s
        self._engine.go_on([[row] for row in rows])
        time_s = [[epoch.time_s] for epoch in epochs]
        positions = self._positions(self._localizer.run(self._engine, time_s), time_s)
        for i, position in enumerate(positions):
            if is_lost(position.nis.values()):
                log = log_from([epochs[i]])
                start = start_at(log, 0, self._scene, self.radio, sure=True)
                if start:
                    positions[i] = self._restarted(users[i], log, start)
        return positions

    def _store(self) -> None:
        """Keep the tracks in the engine, which other tracks will use."""
        if not self._loaded:
            return
        arrays = [self._engine.read(slice(None))]
        if self._engine.policy:
            arrays += self._engine.policy.memory
        arrays += self._localizer.levels.memory
        for i, user in enumerate(self._loaded):
            user.track = [part[i : i + 1].copy() for part in arrays]

    def _restore(self, users: list[_User]) -> None:
        """Load the tracks of users into an engine."""
        count = len(users)
        n = 1 if count == 1 else max(8, 1 << (count - 1).bit_length())
        if n not in self._engines:
            self._engines[n] = self._localizer.tracks(n)
        self._engine = self._engines[n]
        tracks = zip(*[user.track for user in users], strict=True)
        states, *others = [np.concatenate(parts) for parts in tracks]
        self._engine.write(slice(None), states, np.arange(count))
        for part in self._engine.policy.memory if self._engine.policy else ():
            part[:count] = others.pop(0)
        self._localizer.levels.memory = others
        self._loaded = users

    def _positions(
        self, parts: dict[str, Array], time_s: list[list[float]], begins: bool = False
    ) -> list[Position]:
        """Return the beliefs after the last of T filtered epochs of each of k users."""
        count = len(self._loaded)
        layout = self._localizer.layout
        rejected = parts["memory.rejected"]
        measured = (parts["memory.accepted"] + rejected).tolist()
        for user, times, of_user in zip(self._loaded, time_s, measured, strict=True):
            user.end_s = times[-1]
            for now_s, groups in zip(times, of_user, strict=True):
                if any(groups[: layout.anchors]) or (layout.odometry and groups[-1]):
                    user.last_s = now_s
        last = {name: part[:, -1] for name, part in parts.items()}
        x = last["x"]
        P = last["P"]
        unknown = [None] * count
        origin = self._scene.origin
        levels = self._levels
        columns = [
            [times[-1] for times in time_s],
            x[:, :3].tolist(),
            P[:, _POSITION_ROWS].tolist(),
            x[:, 3:6].tolist(),
            [self._switching.names[int(number)] for number in last["memory.mode"]],
            [
                dict(compress(zip(self._groups, nis, strict=True), of_user[-1]))
                for nis, of_user in zip(last["memory.nis"].tolist(), measured, strict=True)
            ],
            [[*compress(self._groups, no)] for no in rejected[:, -1].tolist()],
            [begins] * count,
            geodetic(origin, x[:, :3]).tolist() if origin else unknown,
            x[:, 7].tolist() if layout.has_bias else unknown,
            np.sqrt(P[:, 35]).tolist() if layout.has_bias else unknown,
            last["trusted"].tolist() if "trusted" in last else unknown,
            (gaussian_levels(P, levels.risk) * last["level_factors"]).tolist()
            if levels
            else unknown,
        ]
        return list(map(Position, *columns))

    def _incoming(self, epochs: Sequence[LiveEpoch]) -> Any:
        """Return k epochs as rows of a table (k, columns)."""
        quick = [] if len(epochs) >= _MANY else list(map(self._quick_incoming, epochs))
        if quick and all(quick):
            return quick
        log = log_from(epochs)
        # An episode's times must increase; the users' time steps are set later.
        log = replace(log, time_s=np.arange(float(len(log))))
        return episode_from(log, self._scene, self.radio).table()

    def _quick_incoming(self, epoch: LiveEpoch) -> list[float] | None:
        """Return the same as :meth:`_incoming` for one epoch; None if this is impossible."""
        placed = epoch.columns.placed(epoch.rows)
        if placed is None:
            return None
        numbers, doppler_anchor = placed
        layout = self._localizer.layout
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
        for group, rows in enumerate(layout.groups):
            for i in range(rows.start, rows.stop):
                own = numbers[size + i]
                link = doppler_anchor if i == doppler else group
                has_noise = i > doppler or not isnan(own) or not isnan(snr[link])
                if has_noise and not isnan(numbers[i]):
                    row[at.z[i]] = numbers[i]
                    row[at.signed_sigma[i]] = sigma[i] if isnan(own) else own
                    visible[group] = True
        for link, snr_db in enumerate(snr):
            if visible[link]:
                row[at.snr_db[link]] = NEUTRAL_SNR_DB if isnan(snr_db) else snr_db
            row[at.doppler_of[link]] = float(link == doppler_anchor)
        if not isnan(numbers[-1]):
            row[at.doppler_spread_hz] = numbers[-1]
        return row


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
