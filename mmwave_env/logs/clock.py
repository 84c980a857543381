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
beginning of the log is compared again with the truth at times moved by the estimate, until what is
left is within its error (Gauss-Newton).
"""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.truth import TrueEpochs, Truth
from mmwave_env.models.measurement import Layout, exact_rows
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, wrap

_STRETCHES, _SHORTEST_S = 32, 2.0  # at most so many; when time runs out of them, two become one
_FEWEST = 5  # stretches that tell how much an estimate is worth
_CHANCE = 0.005  # that a clock without an offset is called one that has some
_PART = 0.01  # of the squared error, raw noise and all: what explains less does not matter
_STEP_M = 1e-3  # over which rows of a link are taken as straight
_ENOUGH, _OUTLIER = 20, 6.0  # epochs for a deviation; deviations of what is no noise
_KEPT = 4096  # epochs of the beginning, to compare again
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


class ClockComparison:
    """A truth's clock beside a log's, in running sums.

    Args:
        scene: whose anchors were measured.
    """

    def __init__(self, scene: Scene) -> None:
        self._anchors, rows = scene.anchors_m.tolist(), 4 * len(scene.anchors_m)
        self._layout = Layout(len(scene.anchors_m))
        self._middle, self._deviation = np.full((2, rows), np.nan)
        # of products of 1, the error, and what it grows by with tau and with s, by stretch and row
        self._sums = np.zeros((_STRETCHES, rows, 6, 6))
        self._length_s, self._first_s = _SHORTEST_S, math.nan
        self._scene, self._kept = scene, list[LogBlock]()

    def beside(self, truth: Truth, blocks: Iterable[LogBlock]) -> Iterator[LogBlock]:
        """The same blocks of a log, compared with a truth on their way."""
        for block in blocks:
            self.add(block, truth.at(block.time_s))
            yield block

    def add(self, log: LogBlock, truth: TrueEpochs) -> None:
        """Take T epochs of a log, and what is true in them."""
        if (room := _KEPT - sum(map(len, self._kept))) > 0:
            self._kept.append(log.part(slice(room)))
        p, v = truth.position_m, truth.velocity_mps
        error = self._difference(log.measurement[:, : self._layout.doppler], self._exact(p))
        error[~np.repeat(log.visible[:, : self._layout.anchors], 4, axis=1)] = np.nan
        self._learn_noise(error)
        error = (error - self._middle) / self._deviation
        error[~(np.abs(error) <= _OUTLIER)] = np.nan
        steps = 0.5 * _STEP_M * np.eye(3)
        ends = [(self._exact(p + step), self._exact(p - step)) for step in steps]
        slopes = [self._difference(*pair) / (_STEP_M * self._deviation) for pair in ends]
        rate = np.einsum("ti,itr->tr", v, slopes)
        self._take(log.time_s, np.stack([np.ones_like(error), error, rate, *slopes], axis=-1))

    def _exact(self, position_m: Array) -> Array:
        """Rows (T, 4 L) of all links at positions (T, 3)."""
        rows = exact_rows([*position_m.T], [0.0] * 3, self._anchors, 0.0, self._layout)
        return np.array(rows[: self._layout.doppler]).T

    def _difference(self, one: Array, other: Array) -> Array:
        difference = one - other
        difference[:, self._layout.angles] = wrap(difference[:, self._layout.angles])
        return difference

    def _learn_noise(self, error: Array) -> None:
        """The middle and the deviation of rows, from the first block that has enough of them."""
        new = np.isnan(self._deviation) & (np.isfinite(error).sum(axis=0) >= _ENOUGH)
        if new.any():
            self._middle[new] = np.nanmedian(error[:, new], axis=0)
            spread = np.nanmedian(np.abs(error[:, new] - self._middle[new]), axis=0)
            self._deviation[new] = np.maximum(1.4826 * spread, _LEAST)

    def _take(self, time_s: Array, terms: Array) -> None:
        """Add products of terms (T, rows, 6) to the sums; where one is NaN, none counts."""
        if math.isnan(self._first_s):
            self._first_s = float(time_s[0])
        while time_s[-1] - self._first_s >= _STRETCHES * self._length_s:
            pairs = self._sums[0::2] + self._sums[1::2]
            self._sums = np.concatenate([pairs, np.zeros_like(pairs)])
            self._length_s *= 2.0
        terms[~np.isfinite(terms).all(axis=-1)] = 0.0
        stretch = ((time_s - self._first_s) / self._length_s).astype(np.intp)
        for s in np.unique(stretch):
            part = terms[stretch == s]
            self._sums[s] += np.einsum("tri,trj->rij", part, part)

    def offset(self, again: Path | None = None) -> ClockOffset | None:
        """The estimate; None where too little was added, or the velocity never changed.

        Args:
            again: the truth's file, to compare the beginning of the log with it at other times.
        """
        found = self._linear()
        return self._refined(found, again) if found and again else found

    def _refined(self, first: ClockOffset, path: Path) -> ClockOffset:
        """An estimate where it is far from where the rows are straight, else the first one."""
        log, seconds = self._kept[0].joined(self._kept), first.seconds
        for _ in range(_ROUNDS):
            moved = ClockComparison(self._scene)
            moved.add(log, Truth(path).at(log.time_s + seconds))
            left = moved._linear()
            if left is None or abs(seconds + left.seconds) > _FARTHEST_S:
                return first
            seconds += left.seconds
            if abs(left.seconds) < 0.1 * left.deviation_s:
                break
        else:
            return first
        if abs(seconds - first.seconds) < left.deviation_s:
            return first
        noise = np.nanmean((moved._deviation / self._deviation) ** 2)
        return ClockOffset(seconds, left.deviation_s, max(0.0, 1.0 - float(noise)), left.limit)

    def _linear(self) -> ClockOffset | None:
        """The estimate to first order."""
        from scipy.stats import t

        sums = self._sums[self._sums[:, :, 0, 0].any(axis=1)]
        total, n = sums.sum(axis=0), len(sums)
        found = _fit(total)
        if n < _FEWEST or not found:
            return None
        seconds, part = found
        fits = filter(None, [_fit(total - stretch) for stretch in sums])
        without = np.array([fit[0] for fit in fits])
        deviation = math.sqrt((n - 1) / n * float(((without - seconds) ** 2).sum()))
        return ClockOffset(seconds, deviation, part, float(t.isf(0.5 * _CHANCE, n - 1)))


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
