"""Localization of a measurement log, block by block (paper, Algorithm 1, Step 3; or an IMM).

A track begins at the first line of sight, which gives its prior. Prediction bridges seconds; after
half a minute without a link the filter is often lost, and confident of a wrong place. So the
segment ends after a long gap, and the next one begins with the next line of sight. In a segment,
every ``window`` epochs are smoothed. A log may be larger than memory, and its track does not depend
on how it is cut into blocks.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.engines.imm_engine import ImmTracker
from mmwave_env.engines.replay import smooth
from mmwave_env.engines.track_engine import EpisodeFilter, Rule, Tracker
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.smoother import SMOOTHING_WINDOW
from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.log_columns import RANGE_LIMITS_M
from mmwave_env.logs.log_tables import LogError, in_windows
from mmwave_env.models.measurement import Layout
from mmwave_env.models.prior import GAP_S, STEEPEST_FIX_RAD, prior_from_fix
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask
from mmwave_env.world.episode import Episode

_FILTERED = ("x", "P", "x_predicted", "P_predicted", "memory.mode", "memory.nis", "memory.accepted")


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackBlock(LogBlock):
    """T consecutive epochs of a log in one segment, with their track.

    Attributes:
        planar: whether z and vz are known exactly.
        x, P: (T, 7), (T, 28) filtered belief after each epoch; covariances are packed. With an IMM
            they are the moments of its mixture, and so are x_predicted and P_predicted.
        x_predicted, P_predicted: (T, 7), (T, 28) belief predicted for each epoch.
        smooth_x, smooth_P: (T, 7), (T, 28) smoothed belief; without smoothing, the filtered one.
        mode: (T,) number of the mode that ran; with an IMM, the most probable mode.
        nis: (T, groups) NIS in that mode; 0 where not visible.
        visible: (T, groups) as of the log, but without the link that gave the prior.
        accepted: (T, groups) whether the gate accepted the group.
    """

    planar: bool
    x: Array
    P: Array
    x_predicted: Array
    P_predicted: Array
    smooth_x: Array
    smooth_P: Array
    mode: NDArray[np.int64]
    nis: Array
    accepted: Mask


def localize(
    blocks: Iterable[LogBlock],
    scene: Scene,
    radio: Radio,
    modes: Sequence[Mode] | Bank,
    rule: Rule | None = None,
    window: int | None = SMOOTHING_WINDOW,
    height_m: float | None = None,
) -> Iterator[TrackBlock]:
    """Yield the track of a log.

    Where the log is damaged, the epochs before the damage are delivered first.

    Args:
        blocks: blocks of the log; each is filtered in one call, so large blocks are faster.
        scene: scene whose anchors were measured.
        radio: profile of the receiver: standard deviations by SNR, oscillator, prior.
        modes: one mode, or the modes that ``rule`` picks from in every epoch; or an IMM's bank.
        rule: as :class:`~mmwave_env.engines.track_engine.Tracker` takes it.
        window: epochs smoothed together; None for no smoothing.
        height_m: height of flat terrain, where it is known (paper, Sec. II-A).

    Raises:
        LogError: from ``blocks``.
        ValueError: there is no line of sight to begin with; or a bank with a rule.
    """
    track = _filtered(segments(blocks), scene, radio, modes, rule, height_m)
    return track if window is None else _smoothed(track, window)


def _filtered(
    blocks: Iterable[LogBlock],
    scene: Scene,
    radio: Radio,
    modes: Sequence[Mode] | Bank,
    rule: Rule | None,
    height_m: float | None,
) -> Iterator[TrackBlock]:
    """Yield the filtered track of the segments of a log."""
    tracker: EpisodeFilter[Any] | None = None
    planar = height_m is not None
    for block in blocks:
        episode = episode_from(block, scene, radio, block.begins)
        tracker = tracker or _tracker(modes, rule, block.layout, planar)
        if height_m is not None:
            episode = episode.on_flat_ground(height_m)
        tracker.load([episode], go_on=not block.begins)
        parts = tracker.run(*_FILTERED).items()
        track: dict[str, Any] = {name.removeprefix("memory."): of[0] for name, of in parts}
        track["mode"], track["accepted"] = track["mode"].astype(np.int64), track["accepted"] > 0.5
        track |= {"smooth_x": track["x"], "smooth_P": track["P"], "visible": episode.visible}
        yield from _while_finite(TrackBlock(**{**vars(block), **track}, planar=planar))


def _tracker(
    modes: Sequence[Mode] | Bank, rule: Rule | None, layout: Layout, planar: bool
) -> EpisodeFilter[Any]:
    """Return the engine that filters a single track."""
    if not isinstance(modes, Bank):
        return Tracker(Pipeline(tuple(modes), layout, planar), 1, rule)
    if rule is not None:
        raise ValueError("rule: found one with a bank, expected none, because its IMM runs all")
    return ImmTracker(modes, layout, 1, planar)


def _while_finite(track: TrackBlock) -> Iterator[TrackBlock]:
    """Yield the track up to the first state that is not finite; refuse the rest of the block."""
    lost = np.flatnonzero(~np.isfinite(track.x).all(axis=1) | ~np.isfinite(track.P).all(axis=1))
    if not len(lost):
        yield track
        return
    first = int(lost[0])
    if first:
        yield track.part(slice(first))
    raise LogError(
        f"log, time {track.time_s[first]} s: found no finite state after this epoch, expected "
        "measurements that a receiver can make"
    )


def episode_from(block: LogBlock, scene: Scene, radio: Radio, begins: bool = True) -> Episode:
    """Return epochs of a log as an episode whose truth is not known.

    Args:
        block: the epochs.
        scene: scene whose anchors were measured.
        radio: profile of the receiver, for standard deviations and the prior.
        begins: whether a track begins here, with a prior from the link to anchor 1; this link
            is then not visible, or it would be used twice. Otherwise the prior has no meaning.
    """
    visible, prior = block.visible, (np.zeros(7), np.eye(7))
    if begins:
        fix = block.measurement[0, :4], radio.sigma(block.snr_db, scene, block.layout)[0, :4]
        prior = prior_from_fix(scene.anchors_m[0], *fix, radio, scene)
        visible = visible.copy()
        visible[0, 0] = False
    return Episode.measured(
        "log",
        scene,
        radio,
        block.layout,
        time_s=block.time_s,
        measurement=block.measurement,
        visible=visible,
        snr_db=block.snr_db,
        doppler_spread_hz=block.doppler_spread_hz,
        prior=prior,
    )


# --- segments


def segments(blocks: Iterable[LogBlock]) -> Iterator[LogBlock]:
    """Yield the epochs of the segments of a log, each block within one segment.

    A segment ends when neither a link nor odometry was seen for more than ``GAP_S``, or where the
    log says that a track must begin anew. The next segment begins with the next line of sight.

    Raises:
        LogError: from ``blocks``, after the epochs before the damage.
        ValueError: there is no line of sight to begin with.
    """
    held: LogBlock | None = None  # held until its number of dropped epochs is known
    skipped, incomplete = 0, 0
    last_s: float | None = None  # last time with a measurement; None between segments
    try:
        for whole in blocks:
            block = whole
            while len(block):
                begins = last_s is None
                if last_s is None:
                    first = _first_fix(block)
                    if held:
                        held = replace(held, dropped=held.dropped + first)
                    else:
                        skipped += first
                        incomplete += int(block.incomplete[:first, 0].sum())
                    block = block.part(slice(first, None))
                    if not len(block):
                        break
                    last_s = float(block.time_s[0])
                end, last_s = _end(block, last_s, begins)
                if end:
                    if held:
                        yield held
                    held = replace(
                        block.part(slice(end)),
                        segment=held.segment + begins if held else 0,
                        begins=begins,
                        skipped=skipped,
                        dropped=held.dropped if held else 0,
                    )
                block = block.part(slice(end, None))
    except LogError:
        if held:
            yield held
        raise
    if not held:
        raise ValueError(
            f"log: found {skipped} epochs without a line of sight, expected one with a range of "
            f"at least {RANGE_LIMITS_M[0]:g} m, angles and SNR of anchor 1, and an elevation of at "
            f"most {np.degrees(STEEPEST_FIX_RAD):g} degrees, where the track begins "
            f"({incomplete} have only some of these)"
        )
    yield held


def gives_fix(links: Array) -> Mask:
    """Tell which links (n, 4 or more), m and rad, give a prior.

    Straight above or below an anchor the azimuth is undefined. Near there the uncertainty of the
    direction grows with the elevation, which a Gaussian does not describe.
    """
    return (links[:, 0] >= RANGE_LIMITS_M[0]) & (abs(links[:, 2]) <= STEEPEST_FIX_RAD)


def _first_fix(block: LogBlock) -> int:
    """Return the index of the first epoch that gives a prior; without one, the number of epochs."""
    fixes = np.flatnonzero(block.visible[:, 0] & gives_fix(block.measurement))
    return int(fixes[0]) if len(fixes) else len(block)


def _end(block: LogBlock, last_s: float, begins: bool) -> tuple[int, float | None]:
    """Count the block's epochs in the segment; return also the time of its last measurement.

    The time is None if the segment ends in this block; ``begins`` tells whether it starts here.
    """
    measured = block.visible[:, : block.layout.anchors].any(axis=1)
    if block.layout.odometry:  # dead reckoning bridges two minutes as well as ten seconds
        measured |= block.visible[:, -1]
    latest = np.maximum.accumulate(np.where(measured, block.time_s, last_s))
    before = np.concatenate([[last_s], latest[:-1]])
    ends = (block.time_s - before > GAP_S) | block.restarts
    ends[0] &= not begins
    over = np.flatnonzero(ends)
    return (int(over[0]), None) if len(over) else (len(block), float(latest[-1]))


# --- smoothing


def _smoothed(blocks: Iterable[TrackBlock], window: int) -> Iterator[TrackBlock]:
    """Yield the track in blocks of whole windows, smoothed together, and the rest of segments."""
    for block in in_windows(blocks, window, lambda block: block.segment):
        epochs = min(window, len(block))
        x, P, x_predicted, P_predicted, time_s = (
            values.reshape(-1, epochs, *values.shape[1:])
            for values in (block.x, block.P, block.x_predicted, block.P_predicted, block.time_s)
        )
        x, P = smooth(x, P, x_predicted, P_predicted, np.diff(time_s), block.planar)
        yield replace(block, smooth_x=x.reshape(block.x.shape), smooth_P=P.reshape(block.P.shape))
