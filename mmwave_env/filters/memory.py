"""The memory of a track: statistics of its past epochs that modes and observations depend on.

The memory is updated twice per epoch: :func:`memory_before` adds the coming epoch before a mode is
chosen, and :func:`memory_after` adds the result of the chosen mode.
"""

from collections.abc import Sequence
from typing import NamedTuple

from mmwave_env.filters.update import ModeResult, capped_log_likelihood
from mmwave_env.models.layout import STATE_SIZE, Layout
from mmwave_env.models.measurement import Epoch
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import dot, minus
from mmwave_env.numerics.numbers import (
    Matrix,
    Number,
    Numbers,
    Pair,
    Vector,
    blend,
    clip,
    minimum,
    sqrt,
    where,
)
from mmwave_env.numerics.pytree import select

WINDOW = 10  # number of epochs in the window for adaptive scaling
GAMMA_LIMITS = (0.5, 2.0)  # limits of the adaptive scale; paper, Sec. III-E
NIS_MEMORY = (0.6, 0.9)  # weights of the past in the fast and the slow NIS average
CORRECTION_MEMORY = 0.8  # weight of the past in the average shift of the position by updates
PREFERENCE_MEMORY = (0.6, 0.85)  # weights of the past in averages of log-likelihood differences
PREFERENCE_LIMIT = 30.0  # differences are clipped to plus or minus this limit
SNR_MEMORY = 0.95  # weight of the past in a link's mean SNR
SPREAD_MEMORY = 0.8  # weight of the past in the average Doppler spread
SNR_UNSEEN_DB = -100.0  # slow mean SNR of a link that has never been measured


class Memory(NamedTuple):
    """Statistics of a track's measurements so far."""

    mode: Number  # number of the mode that ran last
    # number of epochs with links since a link last passed its gate; with a free clock, their time,
    # s, because wild ranges that last for many epochs make no belief wrong
    lockout: Number
    window: Numbers  # (WINDOW,) NIS / dof of all accepted groups, per epoch, newest first
    gamma: Number  # adaptive scale of Q and R
    # nis, accepted, rejected: (groups,) NIS and verdicts of the last epoch; 0 for missing groups
    nis: Numbers
    accepted: Numbers
    rejected: Numbers
    nis_average: Numbers  # (2,) fast and slow average of NIS / dof
    # (2,) average shift of the position by updates, along and across the velocity, m
    correction: Numbers
    unfixed_s: Number  # seconds since a link was last accepted
    snr_mean_db: Numbers  # (L,) slow mean SNR per link
    spread_average_hz: Number  # slow average of the Doppler spread
    # (2, modes) fast and slow average of the log-likelihood of a mode minus the log-likelihood of
    # the pipeline's last mode, from :func:`~mmwave_env.filters.update.capped_log_likelihood`
    preference: Matrix


def initial_memory(layout: Layout, modes: int) -> Memory:
    """Return the memory of a track before its first measurement."""
    groups = len(layout.groups)
    anchors = layout.anchors
    return Memory(
        mode=0.0,
        lockout=0.0,
        window=[1.0] * WINDOW,
        gamma=1.0,
        nis=[0.0] * groups,
        accepted=[0.0] * groups,
        rejected=[0.0] * groups,
        nis_average=[1.0, 1.0],
        correction=[0.0, 0.0],
        unfixed_s=0.0,
        snr_mean_db=[SNR_UNSEEN_DB] * anchors,
        spread_average_hz=0.0,
        preference=[[0.0] * modes for _ in PREFERENCE_MEMORY],
    )


def memory_before(
    memory: Memory, candidates: Sequence[ModeResult], epoch: Epoch, layout: Layout
) -> Memory:
    """Return the memory after adding the coming epoch and every mode's result, ``candidates``."""
    snr = []
    for visible, now, mean in zip(epoch.visible, epoch.snr_db, memory.snr_mean_db, strict=False):
        grown = where(mean < SNR_UNSEEN_DB + 1.0, now, blend(SNR_MEMORY, mean, now))
        snr.append(where(visible > 0.5, grown, mean))
    degrees = layout.degrees(epoch.measured)
    likelihoods = [capped_log_likelihood(candidate, degrees) for candidate in candidates]
    gains = [
        clip(likelihood - likelihoods[-1], -PREFERENCE_LIMIT, PREFERENCE_LIMIT)
        for likelihood in likelihoods
    ]
    preference = [
        [blend(keep, old, gain) for old, gain in zip(past, gains, strict=True)]
        for past, keep in zip(memory.preference, PREFERENCE_MEMORY, strict=True)
    ]
    spread = blend(SPREAD_MEMORY, memory.spread_average_hz, epoch.doppler_spread_hz)
    return memory._replace(snr_mean_db=snr, spread_average_hz=spread, preference=preference)


def correction_of(before: Vector, result: ModeResult, dt: Number, first: int) -> Pair:
    """Return what an update adds to position or velocity, along and across the predicted velocity.

    Args:
        before: (7,) mean from which the epoch was predicted.
        result: result of a mode in the epoch.
        dt: length of the step, s.
        first: 0 for the position (m), 3 for the velocity (m/s).
    """
    predicted = move(before[:STATE_SIZE], dt)
    step = [result.x[i] - predicted[i] for i in (first, first + 1)]
    v = predicted[3:5]
    speed = sqrt(dot(v, v) + 1e-6)
    return dot(step, v) / speed, (step[1] * v[0] - step[0] * v[1]) / speed


def memory_after(
    layout: Layout,
    mode: Number,
    before: Vector,
    chosen: ModeResult,
    memory: Memory,
    epoch: Epoch,
) -> Memory:
    """Return the memory after the result of the chosen mode has become the belief.

    Args:
        layout: which quantity is in which row of a measurement.
        mode, chosen: number of the chosen mode, and its result.
        before: (7,) mean from which the epoch was predicted.
        memory: the memory that :func:`memory_before` returned.
        epoch: the epoch that has been filtered.
    """
    accepted_dof = dot(chosen.accepted, layout.degrees(epoch.measured))
    some = accepted_dof > 0.5
    ratio = dot(chosen.accepted, chosen.nis) / where(some, accepted_dof, 1.0)
    window = select(some, [ratio, *memory.window[:-1]], memory.window)
    links = sum(epoch.visible[: layout.anchors], 0.0)
    fixes = sum(chosen.accepted[: layout.anchors], 0.0)
    # A link that is accepted only because of a lock-out does not end the lock-out: the update
    # corrects the position, but the velocity may still be wrong. A link must pass its gate again.
    step = minimum(epoch.dt, 1.0) if layout.clock == "free" else 1.0
    lockout = where(links > 0.5, memory.lockout + step, memory.lockout)
    correction = correction_of(before, chosen, epoch.dt, 0)
    return memory._replace(
        mode=mode,
        lockout=where(chosen.passed > 0.5, 0.0, lockout),
        window=window,
        gamma=clip(dot(window, [1.0 / WINDOW] * WINDOW), *GAMMA_LIMITS),
        nis=chosen.nis,
        accepted=chosen.accepted,
        rejected=minus(epoch.visible, chosen.accepted),
        nis_average=[
            where(some, blend(keep, old, ratio), old)
            for old, keep in zip(memory.nis_average, NIS_MEMORY, strict=True)
        ],
        correction=[
            blend(CORRECTION_MEMORY, old, new)
            for old, new in zip(memory.correction, correction, strict=True)
        ],
        unfixed_s=where(fixes > 0.5, 0.0, memory.unfixed_s + epoch.dt),
    )
