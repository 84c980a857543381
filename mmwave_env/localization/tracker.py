"""Live localization: epochs go in one by one, and a position comes out at once."""

from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.localization.localizer import (
    Switching,
    episode_from,
    filtered_of,
    learned,
    smoothed,
)
from mmwave_env.localization.map_files import geodetic
from mmwave_env.localization.segments import can_begin
from mmwave_env.logs.live_log import LiveLog
from mmwave_env.logs.log import LogBlock
from mmwave_env.models.layout import clock_from
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.models.scene import Scene, scene_from
from mmwave_env.numerics.numbers import Array


class Position(NamedTuple):
    """The belief after an epoch.

    Attributes:
        time_s: time of the epoch.
        position_m: (3,) in the frame of the scene.
        covariance_m2: (3, 3) of the position.
        velocity_mps: (3,).
        mode: name of the mode that ran, or of the most probable mode.
        nis: NIS of every group of measurements that was seen, by name.
        rejected: names of the groups that the gates rejected.
        begins: whether a track begins here, with a first position from the links.
        geodetic: latitude and longitude (degrees) and height (m); None in a scene without origin.
        clock_m, clock_sigma_m: range bias of the user's clock and its standard deviation; None
            where clocks are synchronized.
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


class Tracker:
    """A track that grows by an epoch at a time, the same to the last bit as that of a whole log.

    ```python
    >>> tracker = Tracker("street", policy="guided")
    >>> rows = [{"time_s": 0.0, "anchor": 1, "range_m": 71.2, "aoa_azimuth_deg": -45.1,
    ...          "aoa_elevation_deg": -6.9, "aod_azimuth_deg": 134.8, "snr_db": 22.0}]
    >>> tracker.update(rows).position_m  # doctest: +SKIP

    ```

    Args:
        scene: scene whose anchors are measured: a name, a JSON file or a Scene.
        policy: policy file, or name of a shipped policy; or modes and who chooses between them.
        radio: profile of the receiver.
        snr_db: SNR of links without one.
        height_m: height of flat terrain, where it is known.
        lag: epochs by which :meth:`smoothed` is late.
        clock: "synchronized", or "offset" for a user's clock whose offset is unknown.
    """

    def __init__(
        self,
        scene: str | Path | Scene,
        policy: str | Path | Switching = "guided",
        radio: str | Path | Radio = "handset",
        snr_db: float | None = None,
        height_m: float | None = None,
        lag: int = 10,
        clock: str = "synchronized",
    ) -> None:
        self._clock = clock_from(clock)
        self._scene, self._radio = scene_from(scene), radio_from(radio)
        self._switching = (
            policy if isinstance(policy, Switching) else learned(policy, self._radio.name)
        )
        self._snr_db, self._height_m = snr_db, height_m
        self._log: LiveLog | None = None
        self._filter: Any = None
        self._last_s: float | None = None  # time of the last measurement; None before a track
        # of the last epochs: time, Doppler spread, mode, and what the smoother needs
        self._late: deque[tuple[float, float, str, Array]] = deque(maxlen=lag + 1)

    def update(self, rows: Iterable[Mapping[str, Any]]) -> Position | None:
        """Take the rows of an epoch; return the belief after it.

        Args:
            rows: one mapping an anchor, from names of columns (docs/data.md) to numbers; None, or
                no key, for what was not measured.

        Returns:
            None before the first epoch that determines a position, and in long gaps.

        Raises:
            LogError: a row is damaged or late; the epoch is left out.
        """
        rows, blocks = list(rows), []
        if self._log is None:
            names = dict.fromkeys(name for row in rows for name in row)
            self._log = LiveLog(list(names), self._scene, self._snr_db, clock=self._clock)
        for row in rows:
            blocks += self._log.add(row)
        position = None
        for block in [*blocks, *self._log.end_epoch()]:
            position = self.step(block)
        return position

    def step(self, block: LogBlock) -> Position | None:
        """Take an epoch of a log, a block with T = 1; see :meth:`update`."""
        time_s, layout = float(block.time_s[0]), block.layout
        spread_hz, self._layout = float(block.doppler_spread_hz[0]), layout
        begins = self._last_s is None or time_s - self._last_s > GAP_S
        if begins:
            self._last_s = None
            if not can_begin(block, 0, self._scene, self._radio):
                return None
        links = block.visible[0, : layout.anchors].any()
        if begins or links or (layout.odometry and block.visible[0, -1]):
            self._last_s = time_s
        episode = episode_from(block, self._scene, self._radio, begins)
        if self._height_m is not None:
            episode = episode.on_flat_ground(self._height_m)
        if self._filter is None:
            self._filter = self._switching.tracker(layout, self._height_m is not None)
        self._filter.load([episode], go_on=not begins)
        parts = {name: of[0] for name, of in self._filter.run(*self._switching.parts).items()}
        if begins:
            self._late.clear()
        mode = self._switching.names[int(parts["memory.mode"][0])]
        self._late.append((time_s, spread_hz, mode, filtered_of(parts)))
        visible, names = episode.visible[0], layout.group_names
        accepted, nis = parts["memory.accepted"][0] > 0.5, parts["memory.nis"][0]
        return self._position(
            time_s, parts["x"][0], parts["P"][0], mode,
            {names[g]: float(nis[g]) for g in np.flatnonzero(visible)},
            [names[g] for g in np.flatnonzero(visible & ~accepted)], begins,
        )  # fmt: skip

    def smoothed(self) -> Position | None:
        """Return the position ``lag`` epochs ago, smoothed by the epochs since.

        None before the track is that long.
        """
        if len(self._late) < (self._late.maxlen or 0):
            return None
        times, spreads, modes, parts = zip(*self._late, strict=True)
        x, P = smoothed(
            self._switching, self._layout, self._height_m is not None, self._scene,
            np.concatenate(parts)[None], np.array([times]), np.array([spreads]),
        )  # fmt: skip
        return self._position(times[0], x[0, 0], P[0, 0], modes[0], {}, [], False)

    def _position(
        self, time_s: float, x: Array, P: Array, mode: str, nis: dict[str, float],
        rejected: list[str], begins: bool,
    ) -> Position:  # fmt: skip
        row, column = np.tril_indices(3)
        covariance = np.empty((3, 3))
        covariance[row, column] = covariance[column, row] = P[:6]
        origin, place = self._scene.origin, None
        if origin is not None:
            place = geodetic(origin, x[None, :3])[0].tolist()
        clock = [float(x[7]), float(np.sqrt(P[35]))] if len(x) > 7 else []
        return Position(
            time_s, x[:3].tolist(), covariance.tolist(), x[3:6].tolist(), mode, nis, rejected,
            begins, place, *clock,
        )  # fmt: skip
