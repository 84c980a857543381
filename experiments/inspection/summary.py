"""What there is to say about epochs, in running sums: they may be more than fit into memory."""

from typing import Any

import numpy as np

from experiments.evaluation.thinned import Thinned
from experiments.inspection.data_set import DataSet, Epochs
from mmwave_env.episodes.mobility import FASTEST_MPS
from mmwave_env.models.prior import GAP_S
from mmwave_env.numerics.arrays import Array

_STEPS = 10_000  # at the beginning, whose median is the step of the data set
_UNEVEN = 0.1  # of a step
_SPEED_BINS = np.concatenate([np.arange(0.0, FASTEST_MPS, 0.01), [np.inf]])  # of percentiles
_POINTS = 4000  # drawn of a data set of any length, at least half of them


class Summary:
    """Counts, times, speeds and anchors of the epochs of a data set.

    Attributes:
        drawn: (n, 4 + L) time, position, and whether each anchor was seen, of some of the epochs.
    """

    def __init__(self, anchors: int) -> None:
        self.count, self.known, self.gaps, self.uneven, self.jumps = 0, 0, 0, 0, 0
        self.seen, self.without = np.zeros(anchors, np.int64), 0
        self.first_s = self.last_s = np.nan
        self.longest_s, self.step_s = 0.0, np.nan
        self._speeds = np.zeros(len(_SPEED_BINS) - 1, np.int64)
        self._fastest = 0.0
        self._before = np.empty((0, 4))  # time and position of the epoch before
        self.drawn = Thinned(4 + anchors, _POINTS)

    def add(self, epochs: Epochs) -> None:
        """Take more of them."""
        if not self.count:
            self.first_s = float(epochs.time_s[0])
        rows = np.column_stack([epochs.time_s, epochs.position_m])
        joined = np.concatenate([self._before, rows])
        self._before = rows[-1:]
        self.count, self.last_s = self.count + len(rows), float(epochs.time_s[-1])
        self.known += int(np.isfinite(rows).all(axis=1).sum())
        self.seen += epochs.visible.sum(axis=0)
        self.without += int((~epochs.visible.any(axis=1)).sum())
        self._take_steps(joined)
        self.drawn.add(np.column_stack([rows, epochs.visible]))

    def _take_steps(self, rows: Array) -> None:
        """Times and speeds from epoch to epoch, of rows (n, 4)."""
        if len(rows) < 2:
            return
        steps = np.diff(rows[:, 0])
        if np.isnan(self.step_s):
            self.step_s = float(np.median(steps[:_STEPS]))
        self.longest_s = max(self.longest_s, float(steps.max()))
        self.gaps += int((steps > GAP_S).sum())
        self.uneven += int((abs(steps - self.step_s) > _UNEVEN * self.step_s).sum())
        speed = np.linalg.norm(np.diff(rows[:, 1:], axis=0), axis=1) / steps
        speed = speed[np.isfinite(speed) & (steps <= GAP_S)]
        self._speeds += np.histogram(speed, _SPEED_BINS)[0]
        self._fastest = max(self._fastest, float(speed.max(initial=0.0)))
        self.jumps += int((speed > FASTEST_MPS).sum())

    def _speed_at(self, share: float) -> float:
        """The speed that a share of the steps is below, to 0.01 m/s."""
        below = np.cumsum(self._speeds)
        return min(float(_SPEED_BINS[np.searchsorted(below, share * below[-1]) + 1]), self._fastest)

    def figures(self, found: DataSet) -> dict[str, Any]:
        """All of it, for JSON and for the tables."""
        moving = found.are_true and found.timed and self._speeds.sum()
        speeds = {f"{p} %": self._speed_at(p / 100.0) for p in (50, 95)} if moving else {}
        n = self.count
        return {
            "format": found.format,
            "timed": found.timed,
            "epochs": n,
            "first_s": self.first_s,
            "last_s": self.last_s,
            "duration_s": self.last_s - self.first_s,
            "step_s": None if np.isnan(self.step_s) else self.step_s,
            "longest_step_s": self.longest_s,
            "gaps": self.gaps,
            "uneven_steps": self.uneven,
            "positions": {"from": found.positions, "known": self.known},
            "speed_mps": {**speeds, "max": self._fastest} if moving else None,
            "anchors": [
                {"position_m": place.tolist(), "seen": int(seen), "share": float(seen / n)}
                for place, seen in zip(found.anchors_m, self.seen, strict=True)
            ],
            "line_of_sight": float(self.seen[0] / n) if len(self.seen) else None,
            "facts": found.facts,
            "problems": [
                *self._oddities(found),
                *found.problems,
                *([str(found.damage)] * bool(found.damage)),
            ],
        }

    def _oddities(self, found: DataSet) -> list[str]:
        """What the counts themselves say."""
        said = [
            (self.gaps * found.timed, f"gaps of more than {GAP_S:g} s: tracks begin anew there"),
            (
                self.jumps * found.timed,
                f"steps faster than {FASTEST_MPS:g} m/s: are units and order right?",
            ),
            (self.count - self.known if found.are_true else 0, "epochs without a true position"),
            (self.without if len(self.seen) else 0, "epochs in which no anchor was seen"),
        ]
        never = [f"anchor {a + 1} was never seen" for a in np.flatnonzero(self.seen == 0)]
        return [f"{count} {what}" for count, what in said if count] + never
