"""Facts about a measurement log: epochs, rate, anchors, speeds, and irregularities."""

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from experiments.console.tables import grid
from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.log_tables import LogError
from mmwave_env.logs.truth import Truth
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.mobility import FASTEST_MPS

_UNEVEN = 0.1  # share of the median step


class LogFacts(NamedTuple):
    """Facts about a log, and the damage at which reading ended, if any."""

    figures: dict[str, Any]
    damage: LogError | None


class _Sums:
    """Running sums over the epochs of a log, which may not fit in memory."""

    def __init__(self, anchors: int) -> None:
        self.epochs = self.gaps = self.uneven = self.jumps = self.without = 0
        self.seen = np.zeros(anchors, np.int64)
        self.incomplete: Counter[str] = Counter()
        self.first_s = self.last_s = self.step_s = np.nan
        self.distance_m = self.moving_s = self.fastest_mps = 0.0
        self._before = np.empty((0, 4))  # time and true position of the last epoch

    def add(self, block: LogBlock, position_m: Array) -> None:
        """Add a block with its true positions (T, 3), NaN where not known."""
        rows = np.column_stack([block.time_s, position_m])
        joined = np.concatenate([self._before, rows])
        self.first_s = self.first_s if self.epochs else float(block.time_s[0])
        self._before, self.last_s = rows[-1:], float(block.time_s[-1])
        self.epochs += len(rows)
        links = block.visible[:, : block.layout.anchors]
        self.seen += links.sum(axis=0)
        self.without += int((~links.any(axis=1)).sum())
        counts = block.incomplete.sum(axis=0).tolist()
        self.incomplete.update(dict(zip(block.layout.group_names, counts, strict=True)))
        if len(joined) > 1:
            self._add_steps(joined)

    def _add_steps(self, rows: Array) -> None:
        steps, moved = np.diff(rows[:, 0]), np.linalg.norm(np.diff(rows[:, 1:], axis=0), axis=1)
        if np.isnan(self.step_s):
            self.step_s = float(np.median(steps))
        self.gaps += int((steps > GAP_S).sum())
        self.uneven += int((abs(steps - self.step_s) > _UNEVEN * self.step_s).sum())
        known = np.isfinite(moved) & (steps <= GAP_S)
        speed = moved[known] / steps[known]
        self.distance_m += float(moved[known].sum())
        self.moving_s += float(steps[known].sum())
        self.fastest_mps = max(self.fastest_mps, float(speed.max(initial=0.0)))
        self.jumps += int((speed > FASTEST_MPS).sum())

    def problems(self) -> list[str]:
        """Return sentences about irregular counts."""
        said = [
            (self.gaps, f"gaps of more than {GAP_S:g} s: tracks begin anew there"),
            (self.uneven, f"steps that differ from {self.step_s:.4g} s by more than 10 %"),
            (self.jumps, f"steps of the truth faster than {FASTEST_MPS:g} m/s"),
            (self.without, "epochs in which no anchor was seen"),
        ]
        said += [
            (count, f"times only some of the numbers of {name}, which count as not measured")
            for name, count in self.incomplete.items()
        ]
        never = [f"anchor {a + 1} was never seen" for a in np.flatnonzero(self.seen == 0)]
        return [f"{count} {what}" for count, what in said if count] + never


def log_facts(blocks: Iterable[LogBlock], scene: Scene, truth: Truth | None) -> LogFacts:
    """Read a log to its end or to the first damage, and collect facts about it."""
    sums, damage = _Sums(len(scene.anchors_m)), None
    try:
        for block in blocks:
            unknown = np.full((len(block), 3), np.nan)
            sums.add(block, truth.at(block.time_s).position_m if truth else unknown)
    except LogError as error:
        damage = error
    epochs = max(sums.epochs, 1)
    figures = {
        "epochs": sums.epochs,
        "first_s": sums.first_s,
        "last_s": sums.last_s,
        "step_s": None if np.isnan(sums.step_s) else sums.step_s,
        "speed_mps": {"mean": sums.distance_m / sums.moving_s, "max": sums.fastest_mps}
        if sums.moving_s
        else None,
        "anchors": [
            {"position_m": place.tolist(), "seen": int(seen), "share": float(seen / epochs)}
            for place, seen in zip(scene.anchors_m, sums.seen, strict=True)
        ],
        "problems": [*sums.problems(), *map(str, filter(None, [damage]))],
    }
    return LogFacts(figures, damage)


def facts_markdown(figures: dict[str, Any]) -> str:
    """Return the figures of a log as Markdown."""
    f, step, speed = figures, figures["step_s"], figures["speed_mps"]
    rate = f", {1.0 / step:.4g} Hz" if step else ""
    lines = [f"{f['epochs']} epochs, {f['first_s']:.10g} to {f['last_s']:.10g} s{rate}"]
    if speed:
        mean, most = speed["mean"], speed["max"]
        lines.append(f"speed by the truth: {mean:.2f} m/s on average, {most:.2f} m/s at most")
    rows = [
        [
            f"{number}{', base station' if number == 1 else ''}",
            *(f"{x:.2f}" for x in anchor["position_m"]),
            f"{anchor['seen']} ({anchor['share']:.1%})",
        ]
        for number, anchor in enumerate(f["anchors"], start=1)
    ]
    table = grid(["anchor", "x m", "y m", "z m", "seen"], rows)
    problems = f["problems"] or ["no problems found"]
    return "\n".join([
        *(f"- {line}" for line in lines), "", table, "", *(f"- {one}" for one in problems), "",
    ])  # fmt: skip
