"""Localization of a measurement log by one or several Kalman filter pipelines, called modes.

If there are several modes, a rule (paper, Algorithm 1) or a policy chooses between them, or they
interact as an IMM. A policy may also correct beliefs (it is then called a *corrector*).
The log is divided into segments at long gaps (``segments.py``). In each segment, a track starts
from a first position. The track is filtered first, and then smoothed, ``window`` epochs at a time;
a *two-way corrector* may correct the smoothed track.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from mmwave_env.engines.engine import Engine
from mmwave_env.engines.smoothing import SMOOTHED, smooth, smoothed_features
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.smoother import SMOOTHING_WINDOW
from mmwave_env.interface.policy import Switching, TrackCorrector
from mmwave_env.localization.levels import GAUSSIAN_LEVELS, PARTS, Levels
from mmwave_env.localization.segments import Segment, begun_again, segments
from mmwave_env.localization.starts import Start
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.numbers import Array, Index, Mask
from mmwave_env.world.episode import Episode, columns_of

_CHUNK = 1 << 14  # epochs that are filtered and smoothed together


@dataclass(frozen=True, eq=False, kw_only=True)
class Track(Log):
    """T epochs of a log with their track; epochs outside segments are left out.

    The links from which a prior was computed are not ``visible``. With an IMM, a belief is the
    mean and covariance of the mixture, and ``mode`` is the most probable mode.
    """

    modes: Sequence[str]  # names of the modes
    planar: bool  # whether z and vz are known exactly
    skipped: int  # number of epochs of the log before the first segment
    dropped: int  # number of epochs of the log between segments and after the last
    segment: Index  # (T,) number, from 0, of the segment
    # x, P: means (T, 7), packed covariances (T, 28); (T, 8), (T, 36) if the clock has an offset
    x: Array
    P: Array
    # smooth_x, smooth_P: smoothed belief; without smoothing, the filtered one
    smooth_x: Array
    smooth_P: Array
    mode: Index  # (T,) index of the mode that ran
    nis: Array  # (T, groups) NIS in that mode; 0 where not visible
    accepted: Mask  # (T, groups) whether the gate accepted the group
    # (T,) factor from 0 to 1 by which a corrector's correction was scaled before it was applied to
    # x and P; NaN without a corrector. Smoothing uses beliefs without corrections
    trusted: Array
    smooth_trusted: Array  # (T,) such a factor, from a two-way corrector, for smooth_x, smooth_P
    # (T, 2) factors by which to multiply the horizontal and the vertical Gaussian protection level
    level_factors: Array

    def by_segment(self) -> "list[Track]":
        """Return the tracks of the segments."""
        ends = [0, *(np.flatnonzero(np.diff(self.segment)) + 1).tolist(), len(self)]
        return [self.part(slice(first, end)) for first, end in pairwise(ends)]


@dataclass(frozen=True, eq=False)
class Localizer:
    """Modes that localize a user by logs of one layout; :func:`localize` describes the fields."""

    layout: Layout
    scene: Scene
    radio: Radio
    switching: Switching
    height_m: float | None = None
    levels: Levels = GAUSSIAN_LEVELS
    correlation_s: float = 0.0

    @property
    def planar(self) -> bool:
        """Tell whether the height is known."""
        return self.height_m is not None

    @cached_property
    def pipeline(self) -> Pipeline:
        """Return the modes in this layout."""
        pipeline = self.switching.pipeline(self.layout, self.planar)
        return replace(pipeline, correlation_s=self.correlation_s)

    @cached_property
    def engine(self) -> Engine:
        """Return the engine that filters a single track."""
        return self.tracks(1)

    def tracks(self, n: int) -> Engine:
        """Return an engine that filters n tracks."""
        switching = self.switching
        bank = switching.bank
        if switching.policy:
            policy = switching.start(self.layout, self.planar)
            return Engine(self.pipeline, n, None, switching.observation, bank, policy=policy)
        return Engine(self.pipeline, n, None, "", bank, action="", rule=switching.rule)

    def load(self, log: Log, start: Start | None, before_s: float = 0.0) -> None:
        """Load epochs with which a track begins or, without a start, goes on after ``before_s``."""
        episode = episode_from(log, self.scene, self.radio, start)
        if start:
            self.engine.load([episode])
            if self.planar:
                self.engine.write(self.engine.at.site.prior_x[2], self.height_m)
            self.levels.reset()
            return
        table = episode.table()
        table[0, columns_of(self.layout).dt] = log.time_s[0] - before_s
        self.engine.go_on(table[None])

    def run(self, engine: Engine, time_s: Any) -> dict[str, Array]:
        """Filter the loaded epochs of the first N tracks of an engine.

        Args:
            engine: an engine from :meth:`tracks`.
            time_s: (N, T) times of the epochs.

        Returns:
            Arrays (N, T, ...): the parts :data:`~mmwave_env.localization.levels.PARTS`,
            "memory.mode" and, with a corrector, "trusted"; "kept" is the input of the smoother, and
            "level_factors" (N, T, 2) are factors of Gaussian levels.
        """
        mixes = self.switching.bank is not None
        kept = "mixture" if mixes else SMOOTHED
        outputs = engine.run(*PARTS, "memory.mode", kept)
        parts = {name: part[: len(time_s)] for name, part in outputs.items()}
        parts["kept"] = parts[kept]
        parts["level_factors"] = self.levels.factors(self.layout.anchors, mixes, time_s, parts)
        return parts

    def smoothed(self, kept: Array, time_s: Array, spread_hz: Array) -> tuple[Array, Array]:
        """Return smoothed means (N, T, 7 or 8), packed covariances (N, T, 28 or 36) of N windows.

        ``kept`` (N, T, values) is what :meth:`run` returned. ``time_s`` and the Doppler spreads
        ``spread_hz`` are (N, T).
        """
        dt = np.diff(time_s, prepend=time_s[:, :1])
        hz_per_mps = self.scene.hz_per_mps
        bank = self.switching.bank
        if bank:
            return smooth_modes(bank, self.pipeline, kept, dt, spread_hz, hz_per_mps)
        return smooth(self.pipeline, kept, dt, hz_per_mps)


def localize(
    log: Log,
    scene: Scene,
    radio: Radio,
    switching: Switching,
    window: int | None = SMOOTHING_WINDOW,
    height_m: float | None = None,
    levels: Levels = GAUSSIAN_LEVELS,
    two_way: TrackCorrector | None = None,
    report: Callable[[float], None] = lambda share: None,
    correlation_s: float = 0.0,
) -> Track:
    """Return the track of a log.

    Args:
        log: the log.
        scene, radio: scene whose anchors were measured, and profile of the receiver.
        switching: the modes, and the rule or policy that chooses between them.
        window: number of epochs that are smoothed together; None for no smoothing.
        height_m: height of flat terrain, if it is known (paper, Sec. II-A).
        levels: protection levels.
        two_way: network that corrects the smoothed track; None for no correction. A network needs
            ``height_m=None``, and a bank whose modes have the names of the modes in its training.
        report: function that is called with the share of the log that is done, 0 to 1.
        correlation_s: time for which errors of measurements last; 0 if they are independent.

    Returns:
        The track. If the log is damaged, or a belief becomes NaN or infinite, the track ends before
        this epoch, and ``damage`` is the error.

    Raises:
        LogError: the track would have no epoch because of such an error.
        ValueError: no epoch determines a position with which a track could begin.
    """
    localizer = Localizer(log.layout, scene, radio, switching, height_m, levels, correlation_s)
    log = log.without_steep_angles()
    parts = segments(log, scene, radio)
    tracks = list(_tracks(log, parts, localizer, window, two_way, report))
    joined: Track = Track.joined(tracks)
    if joined.damage and not len(joined):
        raise joined.damage
    skipped = parts[0].epochs.start
    dropped = len(log) - skipped - len(joined) if joined.damage is log.damage else 0
    return replace(joined, skipped=skipped, dropped=dropped)


def _tracks(
    log: Log,
    parts: Sequence[Segment],
    localizer: Localizer,
    window: int | None,
    two_way: TrackCorrector | None,
    report: Callable[[float], None],
) -> Iterator[Track]:
    """Yield the tracks of the segments of a log; where one is lost, another segment begins.

    Segments are divided into chunks of whole windows, because intermediate results are large. The
    first ones are short, because a track that is lost early is filtered in vain.
    """
    whole = window or 1
    number = -1
    size = whole
    before_s = 0.0
    for epochs, begin in parts:
        rest = log.part(epochs)
        start: Start | None = begin
        while len(rest):
            if start:  # here, because a chunk may have fewer epochs than a start spends
                rest = replace(rest, visible=start.unspent(rest.visible))
                number += 1
                size = max(1, (_CHUNK >> 6) // whole) * whole
            chunk = rest.part(slice(size))
            localizer.load(chunk, start, before_s)
            track, start = _track(chunk, start is not None, localizer, number, window, two_way)
            yield track
            if track.damage is not log.damage:
                return
            before_s = chunk.time_s[len(track) - 1]
            rest = rest.part(slice(len(track), None))
            report((epochs.stop - len(rest)) / len(log))
            if 2 * size <= _CHUNK:
                size *= 2


def _track(
    log: Log,
    begins: bool,
    localizer: Localizer,
    segment: int,
    window: int | None,
    two_way: TrackCorrector | None,
) -> tuple[Track, Start | None]:
    """Return the track of a loaded part of a segment, and the start of another if it is lost.

    It ends before a belief that is not finite, and before the other begins. ``segment`` is the
    segment's number, which ``begins`` here or before.
    """
    parts = localizer.run(localizer.engine, log.time_s[None])
    filtered = {name: part[0] for name, part in parts.items()}
    x = filtered["x"]
    P = filtered["P"]
    kept = filtered["kept"]
    unknown = np.full(len(log), np.nan)
    track = Track(
        **vars(log),
        modes=localizer.switching.names,
        planar=localizer.planar,
        skipped=0,
        dropped=0,
        segment=np.full(len(log), segment),
        x=x,
        P=P,
        smooth_x=x,
        smooth_P=P,
        mode=filtered["memory.mode"].astype(np.int64),
        nis=filtered["memory.nis"],
        accepted=filtered["memory.accepted"] > 0.5,
        trusted=filtered.get("trusted", unknown),
        smooth_trusted=unknown,
        level_factors=filtered["level_factors"],
    )
    start = None
    another = begun_again(track, track.nis, begins, localizer.scene, localizer.radio)
    if another:
        end, start = another
        track = track.part(slice(end))
    sound = np.isfinite(track.x).all(axis=1) & np.isfinite(track.P).all(axis=1)
    if not sound.all():
        end = int(np.argmin(sound))
        damage = LogError(
            f"log, line {log.line[end]}, time {log.time_s[end]} s: found measurements that cause "
            "NaN or infinity in the estimate, expected measurements that a receiver can make"
        )
        track = replace(track.part(slice(end)), damage=damage)
    kept = kept[: len(track)]
    if window and len(track):
        spread_hz = track.doppler_spread_hz
        x, P = _by_windows(localizer.smoothed, window, kept, track.time_s, spread_hz)
        track = replace(track, smooth_x=x, smooth_P=P)
        if two_way:
            track = _corrected(track, kept, localizer, window, two_way)
    return track, start


def episode_from(log: Log, scene: Scene, radio: Radio, start: Start | None = None) -> Episode:
    """Return epochs of a log as an episode without true positions.

    If a track begins here, the links that its start has spent are not visible. If none begins, the
    prior is meaningless.
    """
    n = log.layout.state_size
    mean, covariance = start.prior if start else (np.zeros(n), np.eye(n))
    return Episode.measured(
        scene,
        radio,
        log.layout,
        log.snr_db,
        name="log",
        time_s=log.time_s,
        measurement=log.measurement,
        sigma=log.sigma,
        visible=start.unspent(log.visible) if start else log.visible,
        doppler_spread_hz=log.doppler_spread_hz,
        doppler_anchor=log.doppler_anchor,
        prior_mean=mean,
        prior_covariance=covariance,
    )


def _by_windows(run: Callable[..., tuple[Array, ...]], window: int, *parts: Array) -> list[Array]:
    """Apply a function of windows, arrays (N, epochs, ...), to arrays (T, ...); also its results.

    The last window may be shorter than the others.
    """
    T = len(parts[0])
    whole = T // window * window
    results = []
    for rows, epochs in ((slice(0, whole), window), (slice(whole, T), T - whole)):
        if rows.start < rows.stop:
            cut = [part[rows].reshape(-1, epochs, *part.shape[1:]) for part in parts]
            results.append([part.reshape(-1, *part.shape[2:]) for part in run(*cut)])
    return [np.concatenate(part) for part in zip(*results, strict=True)]


def _corrected(
    track: Track, kept: Array, localizer: Localizer, window: int, two_way: TrackCorrector
) -> Track:
    """Correct a part of a smoothed track by windows, which are the smoother's."""
    pipeline = localizer.pipeline
    episode = episode_from(track, localizer.scene, localizer.radio)
    site = episode.site()[None]
    rejected = track.visible & ~track.accepted

    def run(table: Array, x: Array, P: Array, mixtures: Array, *gates: Array) -> tuple[Array, ...]:
        table = table.copy()
        table[:, 0, columns_of(track.layout).dt] = 0.0  # each window begins a track, as in training
        features = smoothed_features(pipeline, table, site, x, P, mixtures, gates)
        shift, log_factor, trusted = (part.astype(float) for part in two_way(pipeline, features))
        belief = corrected_all(x, P, shift, log_factor, pipeline)
        return np.stack(belief.x, axis=-1), np.stack(pack(belief.P), axis=-1), trusted

    gates = track.nis, track.accepted.astype(float), rejected.astype(float)
    x, P, trusted = _by_windows(
        run, window, episode.table(), track.smooth_x, track.smooth_P, kept, *gates
    )
    return replace(track, smooth_x=x, smooth_P=P, smooth_trusted=trusted)
