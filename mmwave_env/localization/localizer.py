"""Localization of a measurement log by one or several Kalman filter pipelines, called modes.

If there are several modes, a rule (paper, Algorithm 1) or a policy chooses between them, or they
interact as an IMM. A policy may also correct beliefs (it is then called a *corrector*).
The log is divided into segments at long gaps (``segments.py``). In each segment, a track starts
from a first position. The track is filtered first, and then smoothed, ``window`` epochs at a time;
a *two-way corrector* may correct the smoothed track.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mmwave_env.engines.engine import Engine, tracks_of
from mmwave_env.engines.smoothed_features import smoothed_features
from mmwave_env.engines.smoothing import smooth
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.smoother import SMOOTHING_WINDOW
from mmwave_env.interface.policy import SmoothedCorrector, Switching
from mmwave_env.localization.levels import GAUSSIAN, Levels
from mmwave_env.localization.policy_tracker import PolicyTracker
from mmwave_env.localization.segments import first_fix, segments
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.numbers import Array, Index, Mask
from mmwave_env.world.episode import Episode, EpisodeBatch, columns_of

_FILTERED = ("x", "P", "memory.mode", "memory.nis", "memory.accepted")
_PREDICTED = ("x_predicted", "P_predicted")
CORRECTED = ("corrected_x", "corrected_P", "trusted")  # parts of the state that a corrector adds
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


def parts_of(switching: Switching) -> tuple[str, ...]:
    """Return the names of the state's parts that the results and the smoother need."""
    return (*_FILTERED, "mixture") if switching.bank else (*_FILTERED, *_PREDICTED)


def tracker_of(switching: Switching, layout: Layout, planar: bool) -> Engine | PolicyTracker:
    """Return the engine that filters a single track."""
    pipeline = switching.pipeline(layout, planar)
    if switching.policy:
        return PolicyTracker(pipeline, switching)
    if switching.bank:
        return tracks_of(pipeline, 1, switching.bank, action="")
    return tracks_of(pipeline, 1, rule=switching.rule)


def localize(
    log: Log,
    scene: Scene,
    radio: Radio,
    switching: Switching,
    window: int | None = SMOOTHING_WINDOW,
    height_m: float | None = None,
    levels: Levels | None = None,
    two_way: SmoothedCorrector | None = None,
    report: Callable[[float], None] = lambda share: None,
) -> Track:
    """Return the track of a log.

    Args:
        log: the log.
        scene, radio: scene whose anchors were measured, and profile of the receiver.
        switching: the modes, and the rule or policy that chooses between them.
        window: number of epochs that are smoothed together; None for no smoothing.
        height_m: height of flat terrain, if it is known (paper, Sec. II-A).
        levels: protection levels; None for Gaussian levels.
        two_way: network that corrects the smoothed track; None for no correction. A network needs
            ``height_m=None``, and a bank whose modes have the names of the modes in its training.
        report: function that is called with the share of the log that is done, 0 to 1.

    Returns:
        The track. If the log is damaged, or a belief becomes NaN or infinite, the track ends before
        this epoch, and ``damage`` is the error.

    Raises:
        LogError: the track would have no epoch because of such an error.
        ValueError: no epoch determines a position with which a track could begin.
    """
    tracker = tracker_of(switching, log.layout, height_m is not None)
    levels = levels or Levels(kind=GAUSSIAN)
    settings = _Settings(scene, radio, switching, tracker, window, height_m, levels, two_way)
    parts = segments(log, scene, radio)
    tracks: list[Track] = []
    for segment, part in enumerate(parts):
        for epochs in _chunks(part, window or 1):
            track = _track(log.part(epochs), settings, begins=epochs.start == part.start)
            number = np.full(len(track), segment)
            tracks.append(replace(track, segment=number, skipped=parts[0].start))
            if track.damage is not log.damage:
                return _joined(tracks)
            report(epochs.stop / len(log))
    track = _joined(tracks)
    return replace(track, dropped=len(log) - track.skipped - len(track))


class _Settings(NamedTuple):
    """Settings that all parts of a track share; :func:`localize` describes them."""

    scene: Scene
    radio: Radio
    switching: Switching
    tracker: Engine | PolicyTracker
    window: int | None
    height_m: float | None
    levels: Levels
    two_way: SmoothedCorrector | None


def _joined(tracks: list[Track]) -> Track:
    """Join the parts of a track; refuse a track without epochs."""
    track: Track = Track.joined(tracks)
    if not len(track) and track.damage:
        raise track.damage
    return track


def _chunks(part: slice, window: int) -> Iterator[slice]:
    """Divide a segment into chunks of whole windows, because intermediate results are large."""
    step = max(1, _CHUNK // window) * window
    for first in range(part.start, part.stop, step):
        yield slice(first, min(first + step, part.stop))


def _track(log: Log, settings: _Settings, begins: bool) -> Track:
    """Return the track of a part of a segment, which ends before a belief that is not finite.

    ``begins`` tells whether the segment begins here.
    """
    episode = episode_from(log, settings.scene, settings.radio, begins)
    if settings.height_m is not None:
        episode = episode.on_flat_ground(settings.height_m)
    settings.tracker.load([episode], go_on=not begins)
    outputs = settings.tracker.run(*parts_of(settings.switching))
    parts = {name: of[0] for name, of in outputs.items()}
    x = parts.get("corrected_x", parts["x"])
    P = parts.get("corrected_P", parts["P"])
    nis = parts["memory.nis"]
    accepted = parts["memory.accepted"] > 0.5
    trusted = parts.get("trusted", np.full(len(log), np.nan))
    factors = settings.levels.of_track(
        begins, log.layout.anchors, settings.switching.bank is not None, log.time_s,
        x, P, nis, episode.visible, accepted, trusted,
    )  # fmt: skip
    track = Track(
        **vars(replace(log, visible=episode.visible)),
        modes=settings.switching.names,
        planar=settings.height_m is not None,
        skipped=0,
        dropped=0,
        segment=np.zeros(len(log), np.int64),
        x=x,
        P=P,
        smooth_x=x,
        smooth_P=P,
        mode=parts["memory.mode"].astype(np.int64),
        nis=nis,
        accepted=accepted,
        trusted=trusted,
        smooth_trusted=np.full(len(log), np.nan),
        level_factors=factors,
    )
    kept = filtered_of(parts)
    sound = np.isfinite(x).all(axis=1) & np.isfinite(P).all(axis=1)
    if not sound.all():
        end = int(np.argmin(sound))
        damage = LogError(
            f"log, line {log.line[end]}, time {log.time_s[end]} s: found measurements that cause "
            "NaN or infinity in the estimate, expected measurements that a receiver can make"
        )
        track = replace(track.part(slice(end)), damage=damage)
        kept = kept[:end]
    if settings.window and len(track):
        track = _smoothed(track, kept, settings, settings.window)
    return track


def episode_from(log: Log, scene: Scene, radio: Radio, begins: bool = True) -> Episode:
    """Return epochs of a log as an episode without true positions.

    If a track ``begins`` here, its prior comes from links of the first epoch. These links are then
    not visible, so that they are not used twice. If no track begins, the prior is meaningless.

    Raises:
        ValueError: a track begins here, but the first epoch determines no position.
    """
    n = log.layout.state_size
    prior = (np.zeros(n), np.eye(n))
    visible = log.visible
    if begins:
        fix = first_fix(log, 0, scene, radio)
        if fix is None:  # segments() begins every segment with a position
            raise ValueError("log: found no position in the first epoch, expected a position")
        prior = fix.prior
        visible = visible.copy()
        visible[0] &= ~fix.used
    return Episode.measured(
        "log",
        scene,
        radio,
        log.layout,
        time_s=log.time_s,
        measurement=log.measurement,
        sigma=log.sigma,
        visible=visible,
        snr_db=log.snr_db,
        doppler_spread_hz=log.doppler_spread_hz,
        doppler_anchor=log.doppler_anchor if log.layout.partial else None,
        prior=prior,
    )


def _smoothed(track: Track, kept: Array, settings: _Settings, window: int) -> Track:
    """Smooth a part of a track by windows, given the smoother's input (T, values); correct it."""

    def run(filtered: Array, time_s: Array, spread_hz: Array) -> tuple[Array, Array]:
        here = settings.switching, track.layout, track.planar, settings.scene
        return smoothed(*here, filtered, time_s, spread_hz)

    x, P = _by_windows(run, window, kept, track.time_s, track.doppler_spread_hz)
    track = replace(track, smooth_x=x, smooth_P=P)
    if settings.two_way:
        return _corrected(track, kept, settings, window, settings.two_way)
    return track


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
            results.append([of.reshape(-1, *of.shape[2:]) for of in run(*cut)])
    return [np.concatenate(of) for of in zip(*results, strict=True)]


def _corrected(
    track: Track, kept: Array, settings: _Settings, window: int, two_way: SmoothedCorrector
) -> Track:
    """Correct a part of a smoothed track by windows, which are the smoother's."""
    layout = track.layout
    pipeline = settings.switching.pipeline(layout, track.planar)
    two_way.read_from_track(pipeline)
    batch = EpisodeBatch.of([episode_from(track, settings.scene, settings.radio, begins=False)])
    mixtures = kept[:, layout.state_size + layout.triangle :]
    rejected = track.visible & ~track.accepted

    def run(table: Array, x: Array, P: Array, mixtures: Array, *gates: Array) -> tuple[Array, ...]:
        table = table.copy()
        table[:, 0, columns_of(layout).dt] = 0.0  # each window begins a track, as in training
        episodes = batch._replace(table=table)
        features = smoothed_features(pipeline, episodes, x, P, mixtures, list(gates))
        shift, log_factor, trusted = (of.astype(float) for of in two_way.correct_tracks(features))
        belief = corrected_all(x, P, shift, log_factor, pipeline)
        return np.stack(belief.x, axis=-1), np.stack(pack(belief.P), axis=-1), trusted

    gates = track.nis, track.accepted.astype(float), rejected.astype(float)
    x, P, trusted = _by_windows(
        run, window, batch.table[0], track.smooth_x, track.smooth_P, mixtures, *gates
    )
    return replace(track, smooth_x=x, smooth_P=P, smooth_trusted=trusted)


def filtered_of(parts: Mapping[str, Array]) -> Array:
    """Return the input (T, values) of the smoother, from parts of the state in T epochs."""
    kept = (values for name, values in parts.items() if name not in {*_FILTERED, *CORRECTED})
    return np.concatenate([parts["x"], parts["P"], *kept], axis=1)


def smoothed(
    switching: Switching,
    layout: Layout,
    planar: bool,
    scene: Scene,
    filtered: Array,
    time_s: Array,
    spread_hz: Array,
) -> tuple[Array, Array]:
    """Return smoothed means (N, T, 7 or 8) and packed covariances (N, T, 28 or 36) of N windows.

    ``filtered`` (N, T, values) comes from :func:`filtered_of`. ``time_s`` and the Doppler
    spreads ``spread_hz`` are (N, T).
    """
    n = layout.state_size
    dt = np.diff(time_s)
    ends = [n, n + layout.triangle]
    x, P, kept = np.split(filtered, ends, axis=2)
    if switching.bank:
        steps = np.pad(dt, ((0, 0), (1, 0)))
        pipeline = switching.pipeline(layout, planar)
        return smooth_modes(switching.bank, pipeline, kept, steps, spread_hz, scene.hz_per_mps)
    return smooth(x, P, kept[..., :n], kept[..., n:], dt, planar, scene.hz_per_mps)
