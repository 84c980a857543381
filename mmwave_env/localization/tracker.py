"""Live localization: a position for every epoch as soon as its rows have arrived."""

import warnings
from collections import deque
from collections.abc import Iterable, Mapping
from math import inf, isnan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.interface.policy import Switching
from mmwave_env.localization.levels import Levels
from mmwave_env.localization.localizer import Localizer
from mmwave_env.localization.map_files import geodetic
from mmwave_env.localization.position_errors import gaussian_levels
from mmwave_env.localization.segments import DOUBTFUL_GAP_S
from mmwave_env.localization.starts import Doubt, Start
from mmwave_env.logs.live_log import LiveEpoch, LiveLog
from mmwave_env.logs.log import Log
from mmwave_env.models.layout import Layout, clock_from
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import SNR_LIMITS_DB, Radio, deviations, radio_from
from mmwave_env.models.scene import Scene, scene_from
from mmwave_env.numerics.numbers import Array
from mmwave_env.numerics.pytree import flatten
from mmwave_env.world.episode import NEUTRAL_SNR_DB, blank_incoming, columns_of, sigma_bounds


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
        clock: "synchronized", or "offset" if the offset of the user's clock is unknown.
        levels: protection levels to compute; None to compute none.
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
    ) -> None:
        self._levels = levels
        self._clock = clock_from(clock)
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
        rows = list(rows)
        position = None
        if not rows:
            return None
        if self._log is None:
            names = dict.fromkeys(name for row in rows for name in row)
            self._log = LiveLog(list(names), self._scene, self._snr_db, clock=self._clock)
        for epoch in self._log.add_epoch(rows):
            position = self.step(epoch)
        for warning in self._log.warnings:
            warnings.warn(warning, stacklevel=2)
        self._log.warnings.clear()
        return position

    def step(self, epoch: LiveEpoch) -> Position | None:
        """Process an epoch of a live log, as :meth:`update` does."""
        if self._filter is not None and epoch.layout != self._layout:
            self._filter = None
            self._last_s = None
            self._doubt = None
        gap_s = inf if self._last_s is None else epoch.time_s - self._last_s
        if gap_s > GAP_S or gap_s <= 0.0:  # a clock that was set back begins a new track, too
            return self._begin(epoch.log())
        if gap_s > DOUBTFUL_GAP_S:
            self._doubt = Doubt(self._scene, self._radio)
        if self._doubt:
            revised = self._doubt.revise(epoch.log())
            if not self._doubt.is_open():
                self._doubt = None
            if revised:
                return self._restart(*revised)
        visible, spread_hz = self._load_quickly(epoch) or self._load(epoch.log())
        return self._filtered([epoch.time_s], [visible], [spread_hz])

    def _begin(self, row: Log) -> Position | None:
        """Begin a track with an epoch (T = 1); return None if it determines no position."""
        if self._last_s is not None or self._doubt is None:
            self._doubt = Doubt(self._scene, self._radio)
            self._last_s = None
        start = self._doubt.begin(row)
        return self._restart(row, start) if start else None

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
        modes = [self._names[int(mode)] for mode in filtered.mode]
        if begins:
            self._late.clear()
        for t, groups in enumerate(visible):
            if any(groups[: self._layout.anchors]) or (self._layout.odometry and groups[-1]):
                self._last_s = time_s[t]
            own = None if factors is None else factors[t : t + 1]
            kept = tuple(part[t : t + 1] for part in filtered.kept)
            self._late.append((time_s[t], spread_hz[t], modes[t], own, kept))
        *_, nis = filtered.nis.tolist()
        *_, accepted = filtered.accepted.tolist()
        trusted = filtered.trusted
        last = None if factors is None else factors[-1:]
        measured = [g for g, is_seen in enumerate(visible[-1]) if is_seen]
        position = self._position(time_s[-1], filtered.x[-1], filtered.P[-1], modes[-1], last)
        return position._replace(
            nis={self._groups[g]: nis[g] for g in measured},
            rejected=[self._groups[g] for g in measured if accepted[g] < 0.5],
            begins=begins,
            trusted=None if trusted is None else float(trusted[-1]),
        )

    def _prepare(self, layout: Layout) -> None:
        """Create the filter and everything else that all epochs share."""
        self._localizer = Localizer(
            layout, self._scene, self._radio, self._switching, self._height_m, self._levels
        )
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

    def _load(self, log: Log) -> tuple[list[bool], float]:
        """Load an epoch (T = 1); return which groups are visible, and the Doppler spread, Hz."""
        visible = self._localizer.load(log)
        return visible[0].tolist(), float(log.doppler_spread_hz[0])

    def _load_quickly(self, epoch: LiveEpoch) -> tuple[list[bool], float] | None:
        """Load an epoch as :meth:`_load` does, but faster; return None if this is impossible."""
        if not epoch.placed or not self._sound:
            return None
        (numbers, doppler_anchor) = epoch.placed
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
        self._filter.load_epoch(row, epoch.time_s)
        return visible, row[at.doppler_spread_hz]

    def smoothed(self) -> Position | None:
        """Return the position ``lag`` epochs ago, smoothed with the epochs since then.

        The result is None as long as the track is too short for this.
        """
        if len(self._late) < (self._late.maxlen or 0):
            return None
        times, spreads, modes, factors, kept = zip(*self._late, strict=True)
        late = np.concatenate([np.concatenate(parts, axis=1) for parts in kept])[None]
        x, P = self._localizer.smoothed(late, np.array([times]), np.array([spreads]))
        return self._position(times[0], x[0, 0], P[0, 0], modes[0], factors[0])

    def _position(
        self, time_s: float, x: Array, P: Array, mode: str, factors: Array | None
    ) -> Position:
        """Return a :class:`Position` without NIS, rejections, ``begins`` and ``trusted``."""
        xx, yx, yy, zx, zy, zz = P[:6].tolist()
        covariance = [[xx, yx, zx], [yx, yy, zy], [zx, zy, zz]]
        origin = self._scene.origin
        place = None
        if origin is not None:
            place = geodetic(origin, x[None, :3])[0].tolist()
        position = Position(
            time_s, x[:3].tolist(), covariance, x[3:6].tolist(), mode, {}, [], False, place
        )
        if self._layout.clock:
            clock_sigma_m = float(np.sqrt(P[35]))
            position = position._replace(clock_m=float(x[7]), clock_sigma_m=clock_sigma_m)
        if self._levels is None or factors is None:
            return position
        levels = gaussian_levels(P, self._levels.risk) * factors[0]
        return position._replace(levels_m=levels.tolist())
