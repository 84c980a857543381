"""Estimate of a constant offset between the clock of a ground-truth track and the clock of a log.

If the clock of the track is ahead by tau, the track's position at time t is where the user was at
t - tau. A range or angle in the log then differs from h(p), its value computed for the track's
position p, by the error

    e = c + (dh/dp) (tau v + s) + noise

to first order. Here, v is the velocity, c is a constant bias of the range or angle, and s is a
constant shift of the frame. Only changes of the velocity distinguish tau from s and c: on a
straight line at constant speed, tau is unobservable. tau is estimated by least squares. Errors are
correlated over seconds, so the standard error is computed by the jackknife, from estimates that
each leave out one stretch of time (B. Efron, C. Stein, "The jackknife estimate of variance", 1981).

The formula is only correct to first order: a user moves by meters within a few tenths of a second,
and h is not linear over this distance. So the log is compared again with the track at times shifted
by the estimate, until the remaining offset is far smaller than its standard error (Gauss-Newton).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log import Log
from mmwave_env.logs.truth import TrueEpochs
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import exact_rows
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, wrap

# maximum number and minimum length of the jackknife's stretches
_STRETCHES = 32
_SHORTEST_S = 2.0
_FEWEST = 5  # minimum number of stretches for a standard error
_CHANCE = 0.005  # probability of finding an offset if there is none
_PART = 0.01  # an offset matters if it explains more than this share of the squared errors
_STEP_M = 1e-3  # step of the numerical derivatives dh/dp
_ENOUGH = 20  # minimum number of epochs for a standard deviation
_OUTLIER = 6.0  # larger errors, in standard deviations, are ignored
_COMPARED = 4096  # maximum number of epochs, from the beginning of the log, that are compared
# maximum number of comparisons, and largest credible offset
_ROUNDS = 12
_FARTHEST_S = 10.0
_LEAST = 1e-6  # m, rad: minimum standard deviation, for logs without noise


class ClockOffset(NamedTuple):
    """An estimate of how far the clock of a ground-truth track is ahead of the clock of a log."""

    seconds: float  # the estimate
    deviation_s: float  # its standard error
    part: float  # share of the squared error, from 0 to 1, that the estimate explains
    limit: float  # chance alone makes |seconds| / deviation_s exceed this in one of 200 cases

    @property
    def matters(self) -> bool:
        """Tell whether the offset is significant, and large enough to correct."""
        return abs(self.seconds) > self.limit * self.deviation_s and self.part > _PART

    def figures(self) -> dict[str, float]:
        """Return the values that are written to results."""
        return {"ahead_s": self.seconds, "deviation_s": self.deviation_s}

    @property
    def advice(self) -> str:
        """Return a sentence that says what is wrong and what to do."""
        side, change = ("ahead of", "-") if self.seconds > 0.0 else ("behind", "+")
        size = 1000.0 * abs(self.seconds)
        deviation = 1000.0 * abs(self.deviation_s)
        return (
            f"found its clock {size:.0f} ± {deviation:.0f} ms {side} the log's, expected no offset"
            "; nothing was changed; if the offset is real, shift the times in this file by "
            f"{change}{size / 1e3:.3f} s"
        )


def clock_offset(
    log: Log, scene: Scene, truth_at: Callable[[Array], TrueEpochs]
) -> ClockOffset | None:
    """Estimate the offset; return None if data are too few, or velocity too constant, to do so.

    ``truth_at`` maps times (T,), by the clock of the track, to true positions.
    """
    log = log.part(slice(_COMPARED))
    seconds = 0.0
    first = None
    for _ in range(_ROUNDS):
        estimate = _linear(log, scene, truth_at(log.time_s + seconds))
        if estimate is None or abs(seconds + estimate[0].seconds) > _FARTHEST_S:
            return None
        first = first or estimate
        left, deviation = estimate
        seconds += left.seconds
        if abs(left.seconds) < 0.1 * left.deviation_s:
            break
    else:
        return None
    if abs(seconds - first[0].seconds) < left.deviation_s:
        return first[0]
    noise = np.nanmean((deviation / first[1]) ** 2)
    return ClockOffset(seconds, left.deviation_s, max(0.0, 1.0 - float(noise)), left.limit)


def _linear(log: Log, scene: Scene, truth: TrueEpochs) -> tuple[ClockOffset, Array] | None:
    """Estimate the offset to first order; also return standard deviations (4 L,) of the errors."""
    from scipy.special import stdtrit

    anchors = scene.anchors_m.tolist()
    layout = Layout(len(scene.anchors_m))

    def exact(position_m: Array) -> Array:
        rows = exact_rows([*position_m.T], [0.0] * 3, anchors, 0.0, layout)
        return np.array(rows[: layout.doppler]).T

    def difference(rows: Array, other: Array) -> Array:
        change = rows - other
        change[:, layout.angles] = wrap(change[:, layout.angles])
        return change

    p = truth.position_m
    v = truth.velocity_mps
    error = difference(log.measurement[:, : layout.doppler], exact(p))
    if log.layout.clock:  # the drift of the user's clock would look like an offset of the track
        error[:, 0::4] = np.nan
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
    terms = np.stack([np.ones_like(error), *slopes, rate, error], axis=-1)
    terms[~np.isfinite(terms).all(axis=-1)] = 0.0
    stretch_s = _SHORTEST_S
    while log.time_s[-1] - log.time_s[0] >= _STRETCHES * stretch_s:
        stretch_s *= 2.0
    ends_at = np.flatnonzero(np.diff((log.time_s - log.time_s[0]) // stretch_s)) + 1
    # For each stretch and row, sum the product of every pair of terms over the epochs. The terms
    # are 1, the derivatives of the error with respect to s and tau, and the error.
    sums = np.array([np.einsum("tri,trj->rij", part, part) for part in np.split(terms, ends_at)])
    sums = sums[sums[:, :, 0, 0].any(axis=1)]
    total = sums.sum(axis=0)
    n = len(sums)
    fit = _fit(total)
    if n < _FEWEST or not fit:
        return None
    seconds, share = fit
    fits = filter(None, [_fit(total - stretch) for stretch in sums])
    without = np.array([fit[0] for fit in fits])
    error_s = math.sqrt((n - 1) / n * float(((without - seconds) ** 2).sum()))
    return ClockOffset(seconds, error_s, share, float(-stdtrit(n - 1, 0.5 * _CHANCE))), deviation


def _fit(sums: Array) -> tuple[float, float] | None:
    """Compute tau, and the share of the squared error that it explains, from sums (rows, 6, 6)."""
    ones = sums[:, 0]
    of_means = ones[:, :, None] * ones[:, None] / np.maximum(ones[:, :1, None], 1.0)
    centered = (sums - of_means).sum(axis=0)[1:, 1:]
    # From the error, and from its derivative with respect to tau, subtract what s explains.
    by_shift = np.linalg.pinv(centered[:3, :3], hermitian=True) @ centered[:3, 3:]
    (changes, both), (_, errors) = (centered[3:, 3:] - centered[3:, :3] @ by_shift).tolist()
    if not (changes > 1e-9 * centered[3, 3] and errors > 0.0):
        return None
    return both / changes, both**2 / (changes * errors)
