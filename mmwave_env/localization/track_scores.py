"""Scores of a track, computed from running sums, because the track may be larger than memory."""

import warnings
from collections.abc import Sequence
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.logs.truth import Truth
from mmwave_env.metrics import RISK, Sums, nees_interval, running_summary
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array

Index = NDArray[np.intp]

FAR_NEES = 100.0  # a larger mean NEES means that the track is far from the truth
_ENOUGH = 100  # number of epochs that are used to estimate the time step


def ratio(part: float, whole: float) -> float | None:
    """Return a share or a mean; None if the whole is zero."""
    return float(part / whole) if whole else None


class Accuracy:
    """ATE, RMSE, RPE and NEES of one track, in 2 or 3 axes; see :mod:`mmwave_env.metrics`."""

    def __init__(self, axes: int) -> None:
        self._interval = nees_interval(axes)
        self._sums = np.zeros(4)  # distance, its square, NEES, epochs in the interval
        self._scored = self._pairs = 0
        self._change = 0.0
        self._waiting = np.empty((0, 3))  # errors not yet paired with the error a second later

    def add(self, error: Array, nees: Array) -> None:
        """Add scored epochs: errors (n, 3), m, and NEES (n,)."""
        distance = np.linalg.norm(error, axis=1)
        inside = (nees >= self._interval[0]) & (nees <= self._interval[1])
        self._sums += [v.sum() for v in (distance, distance**2, nees, inside)]
        self._scored += len(error)
        self._waiting = np.concatenate([self._waiting, error])

    def pair(self, first: Index, second: Index, done: int) -> None:
        """Add the changes between errors with these indices; drop the oldest ``done`` errors."""
        change = self._waiting[second] - self._waiting[first]
        self._change += float(np.linalg.norm(change, axis=1).sum())
        self._pairs += len(change)
        self._waiting = self._waiting[done:]

    def figures(self) -> dict[str, float | None]:
        """Return the running metrics by name, except divergence, which only episodes have."""
        counts = (max(self._scored, 1), self._pairs)
        sums = Sums(*np.array([*counts, *self._sums[:2], self._change, *self._sums[2:], 0.0]))
        known = {"rpe_m": self._pairs}
        return {
            name: float(value) if known.get(name, self._scored) else None
            for name, value in running_summary(sums).items()
            if name != "divergence_rate"
        }


class Pairs:
    """Pairs of scored epochs that are a second apart, or one time step if steps are longer."""

    def __init__(self) -> None:
        # time between the epochs of a pair: the multiple of the time step nearest to a second
        self.apart_s: float | None = None
        self._slack_s = 0.0
        self._first_s = np.empty(0)  # the first times of the log, from which its step is estimated
        self._time_s, self._segment = np.empty(0), np.empty(0, np.int64)  # epochs still to pair

    def add(self, time_s: Array, scored: Index, segment: int) -> None:
        """Add epochs (T,) of one segment of the log, and the indices of those that are scored."""
        more = time_s[: _ENOUGH - len(self._first_s)]
        self._first_s = np.concatenate([self._first_s, more])
        self._time_s = np.concatenate([self._time_s, time_s[scored]])
        self._segment = np.concatenate([self._segment, np.full(len(scored), segment)])

    def take(self, end: bool) -> tuple[Index, Index, int]:
        """Return the indices of pairs among the waiting epochs, and how many epochs to drop now."""
        nothing = np.empty(0, np.intp)
        if self.apart_s is None:
            if len(self._first_s) < (2 if end else _ENOUGH):
                return nothing, nothing, 0
            step = float(np.median(np.diff(self._first_s)))
            self.apart_s, self._slack_s = max(1, round(1.0 / step)) * step, 0.5 * step
        time, n = self._time_s, len(self._time_s)
        later = time + self.apart_s
        done = n if end else int(np.searchsorted(later, time[-1:], "right").sum())
        if not done:
            return nothing, nothing, 0
        after = np.minimum(np.searchsorted(time, later[:done]), n - 1)
        before = np.maximum(after - 1, 0)
        nearer = np.abs(time[before] - later[:done]) < np.abs(time[after] - later[:done])
        second = np.where(nearer, before, after)
        first = np.arange(done)
        paired = (
            (np.abs(time[second] - later[:done]) <= self._slack_s)
            & (second > first)
            & (self._segment[second] == self._segment[:done])
        )
        self._time_s, self._segment = time[done:], self._segment[done:]
        return first[paired], second[paired], done


class TruthScores:
    """Scores of tracks ("filtered", "smoothed" or both) against true positions, planar or in 3D."""

    def __init__(
        self, truth: Truth, names: Sequence[str], planar: bool, risk: float = RISK
    ) -> None:
        self.truth, self.scored, self._risk = truth, 0, risk
        self.errors = {name: PositionErrors(risk, planar) for name in names}
        self._axes: tuple[int, ...] = (0, 1) if planar else (0, 1, 2)
        self._pinned: tuple[int, ...] = VERTICAL if planar else ()
        self._tracks = {name: Accuracy(len(self._axes)) for name in names}
        self._pairs = Pairs()
        self._between, self._away_s = 0, 0.0

    def add(self, block: TrackBlock) -> Array:
        """Score a block; return true positions (T, 3), NaN where not known."""
        truth, _, away = self.truth.at(block.time_s)
        known = np.flatnonzero(~np.isnan(truth[:, 0]))
        self._pairs.add(block.time_s, known, block.segment)
        if len(known):
            self.scored += len(known)
            self._between += int(np.count_nonzero(away[known]))
            self._away_s += float(np.abs(away[known]).sum())
            where = list(truth[known].T)
            for name, accuracy in self._tracks.items():
                smooth = name == "smoothed"
                x, P = (block.smooth_x, block.smooth_P) if smooth else (block.x, block.P)
                covariance = unpack(list(P[known].T), zero=self._pinned)
                belief = Belief(list(x[known].T), covariance, self._axes)
                error = np.column_stack(belief.error(where))
                accuracy.add(error, belief.nees(where))
                self.errors[name].add(error, P[known], block.level_factors[known])
        self._pair()
        return truth

    def warn_if_far(self, track: str) -> None:
        """Warn if the true positions are far from the beliefs of a track."""
        nees = self._tracks[track].figures()["nees"]
        if nees is not None and not nees <= FAR_NEES:
            warnings.warn(
                f"{self.truth.path}: found a mean NEES of {nees:.3g}, expected about "
                f"{len(self._axes)}: is this file in m, in the scene's frame (x east, y north) and "
                "from the same drive, and are the scene's anchors right? If so, the track is lost",
                stacklevel=2,
            )

    def _pair(self, end: bool = False) -> None:
        pairs = self._pairs.take(end)
        for accuracy in self._tracks.values():
            accuracy.pair(*pairs)

    def figures(self) -> dict[str, Any]:
        """Return the accuracy of every track, with reference values to compare it with."""
        self._pair(end=True)
        tracks = {
            name: {**accuracy.figures(), **self.errors[name].figures()}
            for name, accuracy in self._tracks.items()
        }
        paired = any(row["rpe_m"] is not None for row in tracks.values())
        return {
            "scored": self.scored,
            "interpolated": self._between,
            "nearest_pose_s": ratio(self._away_s, self.scored),
            "rpe_s": self._pairs.apart_s if paired else None,
            "nees_expected": len(self._axes),
            "nees_interval": nees_interval(len(self._axes)),
            "risk": self._risk,
            "tracks": tracks,
        }


class Groups:
    """Statistics of groups of measurements: counts, rejections and innovations."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._sums = np.zeros((6, 0))

    def add(self, block: TrackBlock) -> None:
        """Add a block."""
        starts = [group.start for group in block.layout.groups]
        measured = np.isfinite(block.measurement).astype(np.int64)
        whole = np.broadcast_to(block.layout.widths, block.visible.shape)
        rows = np.add.reduceat(measured, starts, axis=1) if block.layout.partial else whole
        low, high = np.array([nees_interval(max(n, 1)) for n in range(5)]).T[:, rows]
        accepted = block.accepted
        counted = (
            block.visible,
            block.visible & ~accepted,
            block.incomplete,
            accepted * rows,
            accepted * block.nis,
            accepted & (block.nis >= low) & (block.nis <= high),
        )
        self._names = [*block.layout.group_names, "all"]
        sums = np.array([part.sum(axis=0) for part in counted], float)
        self._sums = self._sums + sums if self._sums.size else sums

    def figures(self) -> dict[str, dict[str, float | None]]:
        """Return the statistics under the names of the groups, and under "all"."""
        columns = [*self._sums.T, self._sums.sum(axis=1)]
        return {
            name: {
                "seen": int(visible),
                "rejected": int(rejected),
                "rejected_share": ratio(rejected, visible),
                "incomplete": int(incomplete),
                "nis_per_dof": ratio(nis, dof),
                "nis_in_bounds": ratio(inside, visible - rejected),
            }
            for name, (visible, rejected, incomplete, dof, nis, inside) in zip(
                self._names, columns, strict=True
            )
        }


class Course:
    """The course of a track: its times, its speed, and the modes that ran."""

    def __init__(self, modes: Sequence[str]) -> None:
        self.epochs = 0
        self.first_s = self.last_s = 0.0
        self._skipped = self._restarts = self._dropped = self._switches = self._fast = 0
        self._modes, self._counts = modes, np.zeros(len(modes), np.int64)
        self._last_mode = -1
        self._clock: dict[str, Any] = {}  # the clock in the last epoch
        self._speed = self._fastest = self._trusted = 0.0
        self._variance = np.zeros(2)  # sums of the horizontal and the vertical variance, m^2

    def add(self, block: TrackBlock) -> None:
        """Add a block."""
        self._trusted += float(block.trusted.sum())
        xx, yy, zz = block.smooth_P[:, [0, 2, 5]].sum(axis=0)
        self._variance += xx + yy, zz
        if not self.epochs:
            self.first_s, self._last_mode = float(block.time_s[0]), int(block.mode[0])
        self._counts += np.bincount(block.mode, minlength=len(self._modes))
        self._switches += int(np.count_nonzero(np.diff(block.mode, prepend=self._last_mode)))
        self._last_mode = int(block.mode[-1])
        speed = np.linalg.norm(block.x[:, 3:6], axis=1)
        self._speed += float(speed.sum())
        self._fastest = max(self._fastest, float(speed.max()))
        self._fast += int((speed > DESIGN_LIMIT_MPS).sum())
        self._skipped, self._restarts, self._dropped = block.skipped, block.segment, block.dropped
        self.last_s = float(block.time_s[-1])
        self.epochs += len(block)
        if block.layout.clock:
            bias, deviation = float(block.x[-1, 7]), float(np.sqrt(block.P[-1, 35]))
            self._clock = {"clock": {"range_bias_m": bias, "deviation_m": deviation}}

    def figures(self) -> dict[str, Any]:
        """Return the statistics as a dictionary."""
        expected = np.sqrt(self._variance / max(self.epochs, 1))
        return {
            "epochs": self.epochs,
            "skipped": self._skipped,
            "restarts": self._restarts,
            "dropped": self._dropped,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "speed_mps": {
                "mean": ratio(self._speed, self.epochs),
                "max": self._fastest,
                "epochs_above_design_limit": self._fast,
            },
            "expected_rmse_m": dict(
                zip(("horizontal", "vertical"), expected.tolist(), strict=True)
            ),
            "modes": dict(zip(self._modes, self._counts.tolist(), strict=True)),
            "switches": self._switches,
            **self._clock,
            # only if a corrector ran
            **({} if isnan(self._trusted) else {"trusted": ratio(self._trusted, self.epochs)}),
        }
