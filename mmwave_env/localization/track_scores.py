"""Scores of a track against true positions; statistics of its measurements, speeds and modes."""

import warnings
from collections.abc import Sequence
from math import isnan
from typing import Any

import numpy as np

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.logs.truth import Truth
from mmwave_env.metrics import RISK, Sums, nees_interval, running_summary
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Index

FAR_NEES = 100.0  # a larger mean NEES means that the track is far from the true positions
_ENOUGH = 100  # number of epochs that are used to estimate the time step


def ratio(part: float, whole: float) -> float | None:
    """Return part / whole; None if the whole is zero."""
    return float(part / whole) if whole else None


class TruthScores:
    """Scores of tracks ("filtered", "smoothed" or both) against true positions, planar or in 3D.

    :mod:`mmwave_env.metrics` defines ATE, RMSE, RPE and NEES.
    """

    def __init__(
        self, truth: Truth, names: Sequence[str], planar: bool, risk: float = RISK
    ) -> None:
        self.truth = truth
        self.scored = 0
        self._risk = risk
        self.errors = {name: PositionErrors(risk, planar) for name in names}
        self._axes: tuple[int, ...] = (0, 1) if planar else (0, 1, 2)
        self._pinned: tuple[int, ...] = VERTICAL if planar else ()
        self._first_s = np.empty(0)  # the log's first times, from which its time step is estimated
        self._between = 0
        self._away_s = 0.0
        # for scored epochs: [time, segment] (n, 2); by track, [error x, y, z, NEES] (n, 4)
        self._times = [np.empty((0, 2))]
        self._scores = {name: [np.empty((0, 4))] for name in names}

    def add(self, block: TrackBlock) -> Array:
        """Score a block; return the true positions (T, 3), NaN where unknown."""
        truth, _, away = self.truth.at(block.time_s)
        known = np.flatnonzero(~np.isnan(truth[:, 0]))
        self._first_s = np.append(self._first_s, block.time_s)[:_ENOUGH]
        if len(known):
            self.scored += len(known)
            self._between += int(np.count_nonzero(away[known]))
            self._away_s += float(np.abs(away[known]).sum())
            segment = np.full(len(known), block.segment)
            self._times.append(np.column_stack([block.time_s[known], segment]))
            where = list(truth[known].T)
            for name, scores in self._scores.items():
                smooth = name == "smoothed"
                x, P = (block.smooth_x, block.smooth_P) if smooth else (block.x, block.P)
                covariance = unpack(list(P[known].T), zero=self._pinned)
                belief = Belief(list(x[known].T), covariance, self._axes)
                error = np.column_stack(belief.error(where))
                scores.append(np.column_stack([error, belief.nees(where)]))
                self.errors[name].add(error, P[known], block.level_factors[known])
        return truth

    def warn_if_far(self, track: str) -> None:
        """Warn if the true positions are far from the beliefs of a track."""
        nees = np.concatenate(self._scores[track])[:, 3].mean()
        if not nees <= FAR_NEES:
            warnings.warn(
                f"{self.truth.path}: found a mean NEES of {nees:.3g}, expected about "
                f"{len(self._axes)}: is this file in m, in the scene's frame (x east, y north) and "
                "from the same drive, and are the scene's anchors right? If so, the filter failed",
                stacklevel=2,
            )

    def figures(self) -> dict[str, Any]:
        """Return the accuracy of every track, with reference values to compare it with."""
        time_s, segment = np.concatenate(self._times).T
        pairs, apart_s = _pairs(time_s, segment, self._first_s)
        interval = nees_interval(len(self._axes))
        tracks = {
            name: _accuracy(np.concatenate(scores), pairs, interval) | self.errors[name].figures()
            for name, scores in self._scores.items()
        }
        return {
            "scored": self.scored,
            "interpolated": self._between,
            "nearest_pose_s": ratio(self._away_s, self.scored),
            "rpe_s": apart_s if len(pairs) else None,
            "nees_expected": len(self._axes),
            "nees_interval": interval,
            "risk": self._risk,
            "tracks": tracks,
        }


def _pairs(time_s: Array, segment: Array, first_s: Array) -> tuple[Index, float | None]:
    """Pair scored epochs (n,) that are a second apart, or one time step if steps are longer.

    Return indices (pairs, 2) of the earlier and the later epochs, and the time (s) between them:
    the multiple of the time step that is nearest to a second, or None if epochs are too few. Epochs
    of different segments are not paired. The time step is estimated from the times ``first_s``.
    """
    if len(first_s) < 2 or not len(time_s):
        return np.empty((0, 2), np.int64), None
    step = float(np.median(np.diff(first_s)))
    apart_s = max(1, round(1.0 / step)) * step
    later = time_s + apart_s
    after = np.minimum(np.searchsorted(time_s, later), len(time_s) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(time_s[before] - later) < np.abs(time_s[after] - later)
    second = np.where(nearer, before, after)
    first = np.arange(len(time_s))
    paired = (np.abs(time_s[second] - later) <= 0.5 * step) & (second > first)
    paired &= segment[second] == segment
    return np.column_stack([first, second])[paired], apart_s


def _accuracy(
    scores: Array, pairs: Index, interval: tuple[float, float]
) -> dict[str, float | None]:
    """Return :func:`~mmwave_env.metrics.running_summary` of epochs, without the divergence rate.

    All metrics are None if there are no epochs. The RPE is also None if there are no pairs.

    Args:
        scores: (n, 4) errors, m, and NEES of the scored epochs.
        pairs: (pairs, 2) indices of epochs, as :func:`_pairs` returns them.
        interval: interval of the NEES of a consistent filter.
    """
    error = scores[:, :3]
    nees = scores[:, 3]
    n = len(scores)
    distance = np.linalg.norm(error, axis=1)
    change = np.linalg.norm(error[pairs[:, 1]] - error[pairs[:, 0]], axis=1)
    inside = (nees >= interval[0]) & (nees <= interval[1])
    summed = [values.sum() for values in (distance, distance**2, change, nees, inside)]
    sums = Sums(*np.array([max(n, 1), len(pairs), *summed, 0.0]))
    known = {"rpe_m": len(pairs)}
    return {
        name: float(value) if known.get(name, n) else None
        for name, value in running_summary(sums).items()
        if name != "divergence_rate"
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
        """Return the statistics of each group under its name, and their totals under "all"."""
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
    """Statistics of a track: its times, its speeds, and the modes that ran."""

    def __init__(self, modes: Sequence[str]) -> None:
        self.epochs = 0
        self.first_s = self.last_s = 0.0
        self._last: TrackBlock | None = None
        self._modes = modes
        self._counts = np.zeros(len(modes), np.int64)
        self._switches = self._fast = 0
        self._speed = self._fastest = 0.0
        # sums of the trust in corrections of the filtered and of the smoothed track
        self._trusted = {"trusted": 0.0, "smooth_trusted": 0.0}
        self._variance = np.zeros(2)  # sums of the horizontal and the vertical variance, m^2

    def add(self, block: TrackBlock) -> None:
        """Add a block."""
        if self._last is None:
            self.first_s = float(block.time_s[0])
        before = block.mode[0] if self._last is None else self._last.mode[-1]
        self._counts += np.bincount(block.mode, minlength=len(self._modes))
        self._switches += int(np.count_nonzero(np.diff(block.mode, prepend=before)))
        xx, yy, zz = block.smooth_P[:, [0, 2, 5]].sum(axis=0)
        self._variance += xx + yy, zz
        speed = np.linalg.norm(block.x[:, 3:6], axis=1)
        self._speed += float(speed.sum())
        self._fastest = max(self._fastest, float(speed.max()))
        self._fast += int((speed > DESIGN_LIMIT_MPS).sum())
        for name in self._trusted:
            self._trusted[name] += float(getattr(block, name).sum())
        self.last_s = float(block.time_s[-1])
        self._last = block
        self.epochs += len(block)

    def figures(self) -> dict[str, Any]:
        """Return the statistics of a track, of which at least one block was added."""
        last = self._last
        assert last is not None
        expected = np.sqrt(self._variance / self.epochs)
        clock = {}
        if last.layout.clock:
            bias = float(last.x[-1, 7])
            deviation = float(np.sqrt(last.P[-1, 35]))
            clock = {"clock": {"range_bias_m": bias, "deviation_m": deviation}}
        return {
            "epochs": self.epochs,
            "skipped": last.skipped,
            "restarts": last.segment,
            "dropped": last.dropped,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "speed_mps": {
                "mean": self._speed / self.epochs,
                "max": self._fastest,
                "epochs_above_design_limit": self._fast,
            },
            "expected_rmse_m": dict(
                zip(("horizontal", "vertical"), expected.tolist(), strict=True)
            ),
            "modes": dict(zip(self._modes, self._counts.tolist(), strict=True)),
            "switches": self._switches,
            **clock,
            **{name: of / self.epochs for name, of in self._trusted.items() if not isnan(of)},
        }
