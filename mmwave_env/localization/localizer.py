"""Localization of a measurement log by one or several Kalman filter pipelines, called modes.

If there are several modes, a rule (paper, Algorithm 1) or a policy chooses between them, or they
interact as an IMM. A policy may also correct beliefs (it is then called a *corrector*).
A log is a sequence of blocks of epochs, because it may be larger than memory. The length of the
blocks does not change the track. The log is divided into segments at long gaps (``segments.py``).
In each segment, a track starts from a first position. The track is filtered first, and then
smoothed, ``window`` epochs at a time; a *two-way corrector* may correct the smoothed track.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mmwave_env.engines.imm_engine import ImmTracker
from mmwave_env.engines.replay import smooth
from mmwave_env.engines.smoothed_features import smoothed_features
from mmwave_env.engines.track_engine import EpisodeFilter, Tracker
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.smoother import SMOOTHING_WINDOW
from mmwave_env.interface.policy import SmoothedCorrector, Switching
from mmwave_env.localization.levels import GAUSSIAN, Levels
from mmwave_env.localization.policy_tracker import PolicyTracker
from mmwave_env.localization.segments import first_fix, segments
from mmwave_env.logs.log import LogBlock, in_windows
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


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackBlock(LogBlock):
    """T consecutive epochs of a log in one segment, with their track.

    The links from which the prior was computed are not ``visible``. With an IMM, a belief is the
    mean and covariance of the mixture, and ``mode`` is the most probable mode.
    """

    planar: bool  # whether z and vz are known exactly
    # x, P: means (T, 7), packed covariances (T, 28); (T, 8), (T, 36) if the clock has an offset
    x: Array
    P: Array
    # (T, values) input of the smoother: x, P, then the predicted belief or (IMM) the mixture
    filtered: Array
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


def parts_of(switching: Switching) -> tuple[str, ...]:
    """Return the names of the state's parts that the results and the smoother need."""
    return (*_FILTERED, "mixture") if switching.bank else (*_FILTERED, *_PREDICTED)


def tracker_of(
    switching: Switching, layout: Layout, planar: bool
) -> EpisodeFilter[Any] | PolicyTracker:
    """Return the engine that filters a single track."""
    pipeline = switching.pipeline(layout, planar)
    if switching.policy:
        return PolicyTracker(pipeline, switching)
    if switching.bank:
        return ImmTracker(switching.bank, layout, 1, planar)
    return Tracker(pipeline, 1, switching.rule)


def localize(
    blocks: Iterable[LogBlock],
    scene: Scene,
    radio: Radio,
    switching: Switching,
    window: int | None = SMOOTHING_WINDOW,
    height_m: float | None = None,
    levels: Levels | None = None,
    two_way: SmoothedCorrector | None = None,
) -> Iterator[TrackBlock]:
    """Yield the track of a log.

    If the log is damaged, the epochs before the damage are yielded before the error is raised.

    Args:
        blocks: blocks of the log; each is filtered in one call, so large blocks are faster.
        scene, radio: scene whose anchors were measured, and profile of the receiver.
        switching: the modes, and the rule or policy that chooses between them.
        window: number of epochs that are smoothed together; None for no smoothing.
        height_m: height of flat terrain, if it is known (paper, Sec. II-A).
        levels: protection levels; None for Gaussian levels.
        two_way: network that corrects the smoothed track; None for no correction. A network needs
            ``height_m=None``, and a bank whose modes have the names of the modes in its training.

    Raises:
        LogError: the log is damaged, or a belief became NaN or infinite.
        ValueError: no epoch determines a position with which a track could begin.
    """
    levels = levels or Levels(kind=GAUSSIAN)
    track = _filtered(segments(blocks, scene, radio), scene, radio, switching, height_m, levels)
    if window is None:
        return track
    track = _smoothed(track, window, scene, switching)
    return _corrected(track, window, scene, radio, switching, two_way) if two_way else track


def _filtered(
    blocks: Iterable[LogBlock],
    scene: Scene,
    radio: Radio,
    switching: Switching,
    height_m: float | None,
    levels: Levels,
) -> Iterator[TrackBlock]:
    """Yield the filtered track of the segments of a log."""
    tracker: EpisodeFilter[Any] | PolicyTracker | None = None
    planar = height_m is not None
    for block in blocks:
        episode = episode_from(block, scene, radio, block.begins)
        tracker = tracker or tracker_of(switching, block.layout, planar)
        if height_m is not None:
            episode = episode.on_flat_ground(height_m)
        tracker.load([episode], go_on=not block.begins)
        parts = {name: of[0] for name, of in tracker.run(*parts_of(switching)).items()}
        correction = [parts.pop(name, None) for name in CORRECTED]
        track: dict[str, Any] = {name.removeprefix("memory."): parts[name] for name in _FILTERED}
        track["mode"], track["accepted"] = track["mode"].astype(np.int64), track["accepted"] > 0.5
        track["filtered"] = filtered_of(parts)
        track["trusted"] = track["smooth_trusted"] = np.full(len(episode), np.nan)
        if correction[0] is not None:
            track |= dict(zip(("x", "P", "trusted"), correction, strict=True))
        track |= {"smooth_x": track["x"], "smooth_P": track["P"], "visible": episode.visible}
        if block.begins:
            levels.reset()
        gates = track["nis"], track["accepted"], episode.visible & ~track["accepted"]
        read = [values[None] for values in (track["x"], track["P"], *gates, track["trusted"])]
        track["level_factors"] = levels.factors(
            block.layout.anchors, switching.bank is not None, block.time_s, *read
        )[0]
        sound = np.isfinite(track["x"]).all(axis=1) & np.isfinite(track["P"]).all(axis=1)
        end = len(block) if sound.all() else int(np.argmin(sound))
        if end:
            whole = TrackBlock(**{**vars(block), **track}, planar=planar)
            yield whole.part(slice(end))
        if end < len(block):
            raise LogError(
                f"log, time {block.time_s[end]} s: found measurements that cause NaN or infinity "
                "in the estimate, expected measurements that a receiver can make"
            )


def episode_from(block: LogBlock, scene: Scene, radio: Radio, begins: bool = True) -> Episode:
    """Return epochs of a log as an episode without true positions.

    If a track ``begins`` here, its prior comes from links of the first epoch. These links are then
    not visible, so that they are not used twice. If no track begins, the prior is meaningless.

    Raises:
        ValueError: a track begins here, but the first epoch determines no position.
    """
    n = block.layout.state_size
    prior = (np.zeros(n), np.eye(n))
    visible = block.visible
    if begins:
        fix = first_fix(block, 0, scene, radio)
        if fix is None:  # segments() begins every segment with a position
            raise ValueError("log: found no position in the first epoch, expected a position")
        prior = fix.prior
        visible = visible.copy()
        visible[0] &= ~fix.used
    return Episode.measured(
        "log",
        scene,
        radio,
        block.layout,
        time_s=block.time_s,
        measurement=block.measurement,
        sigma=block.sigma,
        visible=visible,
        snr_db=block.snr_db,
        doppler_spread_hz=block.doppler_spread_hz,
        doppler_anchor=block.doppler_anchor if block.layout.partial else None,
        prior=prior,
    )


def _smoothed(
    blocks: Iterable[TrackBlock], window: int, scene: Scene, switching: Switching
) -> Iterator[TrackBlock]:
    """Yield the track, smoothed window by window; a segment's last window may be shorter."""
    for block in in_windows(blocks, window):
        epochs = min(window, len(block))
        parts = block.filtered.reshape(-1, epochs, *block.filtered.shape[1:])
        time_s = block.time_s.reshape(-1, epochs, *block.time_s.shape[1:])
        spread_hz = block.doppler_spread_hz.reshape(-1, epochs, *block.doppler_spread_hz.shape[1:])
        x, P = smoothed(switching, block.layout, block.planar, scene, parts, time_s, spread_hz)
        yield replace(block, smooth_x=x.reshape(block.x.shape), smooth_P=P.reshape(block.P.shape))


def _corrected(
    blocks: Iterable[TrackBlock],
    window: int,
    scene: Scene,
    radio: Radio,
    switching: Switching,
    two_way: SmoothedCorrector,
) -> Iterator[TrackBlock]:
    """Yield the smoothed track, corrected window by window; the windows are the smoother's."""
    for block in blocks:
        layout = block.layout
        pipeline = switching.pipeline(block.layout, block.planar)
        two_way.read_from_track(pipeline)
        epochs = min(window, len(block))
        batch = EpisodeBatch.of([episode_from(block, scene, radio, begins=False)])
        mixtures = block.filtered[:, layout.state_size + layout.triangle :]
        accepted = block.accepted
        rejected = block.visible & ~block.accepted
        shown = block.nis, accepted.astype(float), rejected.astype(float)
        table, x, P, mixtures, *gates = (
            part.reshape(-1, epochs, part.shape[-1])
            for part in (batch.table, block.smooth_x, block.smooth_P, mixtures, *shown)
        )
        table[:, 0, columns_of(layout).dt] = 0.0  # each window begins a track, as in training
        features = smoothed_features(pipeline, batch._replace(table=table), x, P, mixtures, gates)
        shift, log_factor, trusted = (
            part.astype(float) for part in two_way.correct_tracks(features)
        )
        belief = corrected_all(x, P, shift, log_factor, pipeline)
        yield replace(
            block,
            smooth_x=np.stack(belief.x, axis=-1).reshape(block.x.shape),
            smooth_P=np.stack(pack(belief.P), axis=-1).reshape(block.P.shape),
            smooth_trusted=trusted.reshape(-1),
        )


def filtered_of(parts: Mapping[str, Array]) -> Array:
    """Return the input (T, values) of the smoother, from parts of the state in T epochs."""
    kept = (values for name, values in parts.items() if name not in _FILTERED)
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
