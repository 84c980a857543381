"""Whether the clock of a truth differs from that of a log by a constant.

A truth whose times are late by tau tells at time t where the user was at t - tau. What a log
measured differs from what that makes of it, to first order, by

    e = c + (dh/dp) (tau v + s) + noise

in every row h of a link. Its constant c is a bias of the row's own, and s is a frame that is off by
some meters, so that only what changes with the velocity tells of a clock: on a straight way at
an even speed nothing does. tau is the least-squares estimate. Errors hang together over seconds,
so its standard error is that of the jackknife: how it differs when one stretch of time at a time
is left out (B. Efron, C. Stein, "The jackknife estimate of variance", 1981).

To first order only: a tau of tenths of a second is meters, over which a log is not straight. So the
log is compared again with the truth at times moved by the estimate, until what is left is within
its error (Gauss-Newton).
"""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.truth import TrueEpochs
from mmwave_env.models.measurement import Layout, exact_rows
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, wrap

_STRETCHES, _SHORTEST_S = 32, 2.0  # at most so many; when time runs out of them, two become one
_FEWEST = 5  # stretches that tell how much an estimate is worth
_CHANCE = 0.005  # that a clock without an offset is called one that has some
_PART = 0.01  # of the squared error, raw noise and all: what explains less does not matter
_STEP_M = 1e-3  # over which rows of a link are taken as straight
_ENOUGH, _OUTLIER = 20, 6.0  # epochs for a deviation; deviations of what is no noise
_COMPARED = 4096  # epochs of the beginning
_ROUNDS, _FARTHEST_S = 12, 10.0  # of comparing again; beyond it two clocks have nothing in common
_LEAST = 1e-6  # m, rad: deviation of a log without noise


class ClockOffset(NamedTuple):
    """How far the clock of a truth is ahead of that of a log.

    Attributes:
        seconds: the estimate.
        deviation_s: its standard error.
        part: of the squared error, from 0 to 1, that it explains.
        limit: the ratio of both that chance exceeds in one of 200 cases.
    """

    seconds: float
    deviation_s: float
    part: float
    limit: float

    @property
    def matters(self) -> bool:
        """Whether there is one beyond doubt, and worth mending."""
        return abs(self.seconds) > self.limit * self.deviation_s and self.part > _PART

    def figures(self) -> dict[str, float]:
        """What results say of it."""
        return {"ahead_s": self.seconds, "deviation_s": self.deviation_s}

    @property
    def advice(self) -> str:
        """What is wrong, and what to do."""
        side, change = ("ahead of", "less") if self.seconds > 0.0 else ("behind", "more")
        size, deviation = (1e3 * abs(value) for value in (self.seconds, self.deviation_s))
        return (
            f"found its clock {size:.0f} ± {deviation:.0f} ms {side} the log's, expected the same; "
            f"nothing was moved: if that is so, make its times {size / 1e3:.3f} s {change}"
        )


def keeping(blocks: Iterable[LogBlock], kept: list[LogBlock]) -> Iterator[LogBlock]:
    """The same blocks; those at the beginning that :func:`clock_offset` compares are kept."""
    for block in blocks:
        if sum(map(len, kept)) < _COMPARED:
            kept.append(block)
        yield block


def clock_offset(
    log: LogBlock, scene: Scene, truth_at: Callable[[Array], TrueEpochs]
) -> ClockOffset | None:
    """The estimate; None where too little is known, or the velocity never changed.

    Args:
        log: its beginning.
        scene: whose anchors were measured.
        truth_at: what is true at times of the truth's clock.
    """
    log = log.part(slice(_COMPARED))
    found = _linear(log, scene, truth_at(log.time_s))
    if found is None:
        return None
    first, deviation = found
    seconds = first.seconds
    for _ in range(_ROUNDS):
        found = _linear(log, scene, truth_at(log.time_s + seconds))
        if found is None or abs(seconds + found[0].seconds) > _FARTHEST_S:
            return first
        left, moved = found
        seconds += left.seconds
        if abs(left.seconds) < 0.1 * left.deviation_s:
            break
    else:
        return first
    if abs(seconds - first.seconds) < left.deviation_s:
        return first
    noise = np.nanmean((moved / deviation) ** 2)
    return ClockOffset(seconds, left.deviation_s, max(0.0, 1.0 - float(noise)), left.limit)


def _linear(log: LogBlock, scene: Scene, truth: TrueEpochs) -> tuple[ClockOffset, Array] | None:
    """The estimate to first order, and the deviations of the rows of links (4 L,)."""
    from scipy.stats import t

    anchors, layout = scene.anchors_m.tolist(), Layout(len(scene.anchors_m))

    def exact(position_m: Array) -> Array:
        rows = exact_rows([*position_m.T], [0.0] * 3, anchors, 0.0, layout)
        return np.array(rows[: layout.doppler]).T

    def difference(one: Array, other: Array) -> Array:
        found = one - other
        found[:, layout.angles] = wrap(found[:, layout.angles])
        return found

    p, v = truth.position_m, truth.velocity_mps
    error = difference(log.measurement[:, : layout.doppler], exact(p))
    error[~np.repeat(log.visible[:, : layout.anchors], 4, axis=1)] = np.nan
    middle, deviation = np.full((2, layout.doppler), np.nan)
    some = np.isfinite(error).sum(axis=0) >= _ENOUGH
    middle[some] = np.nanmedian(error[:, some], axis=0)
    spread = np.nanmedian(np.abs(error[:, some] - middle[some]), axis=0)
    deviation[some] = np.maximum(1.4826 * spread, _LEAST)
    error = (error - middle) / deviation
    error[~(np.abs(error) <= _OUTLIER)] = np.nan
    ends = [(exact(p + step), exact(p - step)) for step in 0.5 * _STEP_M * np.eye(3)]
    slopes = [difference(*pair) / (_STEP_M * deviation) for pair in ends]
    rate = np.einsum("ti,itr->tr", v, slopes)
    terms = np.stack([np.ones_like(error), error, rate, *slopes], axis=-1)
    terms[~np.isfinite(terms).all(axis=-1)] = 0.0
    stretch_s = _SHORTEST_S
    while log.time_s[-1] - log.time_s[0] >= _STRETCHES * stretch_s:
        stretch_s *= 2.0
    ends_at = np.flatnonzero(np.diff((log.time_s - log.time_s[0]) // stretch_s)) + 1
    # of products of 1, the error, and what it grows by with tau and with s, by stretch and row
    sums = np.array([np.einsum("tri,trj->rij", one, one) for one in np.split(terms, ends_at)])
    sums = sums[sums[:, :, 0, 0].any(axis=1)]
    total, n = sums.sum(axis=0), len(sums)
    found = _fit(total)
    if n < _FEWEST or not found:
        return None
    seconds, part = found
    fits = filter(None, [_fit(total - stretch) for stretch in sums])
    without = np.array([fit[0] for fit in fits])
    error_s = math.sqrt((n - 1) / n * float(((without - seconds) ** 2).sum()))
    return ClockOffset(seconds, error_s, part, float(t.isf(0.5 * _CHANCE, n - 1))), deviation


def _fit(sums: Array) -> tuple[float, float] | None:
    """tau, and the part of the squared error that it explains, from sums (rows, 6, 6)."""
    ones = sums[:, 0]
    of_means = ones[:, :, None] * ones[:, None] / np.maximum(ones[:, :1, None], 1.0)
    centered = (sums - of_means).sum(axis=0)[1:, 1:]
    # What s explains is taken from the error and from the rate; tau is what is left of both.
    by_shift = np.linalg.pinv(centered[2:, 2:], hermitian=True) @ centered[2:, :2]
    error, rate = np.vstack([np.eye(2), -by_shift]).T
    changes, errors = float(rate @ centered @ rate), float(error @ centered @ error)
    if not (changes > 1e-9 * centered[1, 1] and errors > 0.0):
        return None
    seconds = float(rate @ centered @ error) / changes
    return seconds, seconds**2 * changes / errors
