"""Whom a policy trusts around events, what the modes' likelihoods say there, and what it gains.

For a policy of which every mode keeps its own belief. An epoch counts for each event that it is
near to. Intervals are over episodes: events of one episode may depend on each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.events import (
    Windows,
    blockages,
    pull_aways,
    speeds,
    stops,
    turns,
    velocities,
    visible_links,
)
from experiments.evaluation.intervals import Interval, bootstrap_ratio
from experiments.evaluation.markdown import grid
from experiments.evaluation.runner import run_contender, step_s
from experiments.figures.canvas import caption
from experiments.figures.events import Lines, Shares, draw_around_events
from mmwave_env.episodes.episode import Episode
from mmwave_env.numerics.arrays import Array, Mask

EVENTS: dict[str, Callable[[Sequence[Episode]], Mask]] = {
    "stop": lambda episodes: stops(speeds(velocities(episodes))),
    "pull-away": lambda episodes: pull_aways(speeds(velocities(episodes))),
    "turn": lambda episodes: turns(velocities(episodes), step_s(episodes[0])),
    "blockage": lambda episodes: blockages(visible_links(episodes)),
}
AROUND_S = 10.0  # what is looked at, before and after
MOMENTS_S = (-3.0, 0.0, 3.0)  # rows of the table
PROBABILITY = "mixture.probability"


@dataclass(frozen=True)
class Around:
    """What happens around events of one kind, per epoch (w,) around them."""

    events: int  # how many; those cut off at an end of their episode count where they are
    trusted: Array  # (1 + modes, w) share of the epochs in which none or a mode is trusted
    probability: Array  # (modes, w) mean before trust
    error_m: dict[str, list[Interval]]  # (w,) mean position errors, by contender
    gain_m: list[Interval]  # (w,) the error of the policy minus that of its rival


@dataclass(frozen=True)
class Trust:
    """A policy and its rival around every kind of event; its ``str`` is a Markdown table."""

    actions: list[str]  # "none" and the modes
    time_s: Array  # (w,) of epochs around an event
    around: dict[str, Around]  # per kind of event

    @classmethod
    def measured(cls, policy: Contender, rival: Contender, episodes: Sequence[Episode]) -> "Trust":
        """Run both on episodes of one length.

        Args:
            policy: whose modes keep a belief each.
            rival: whose errors stand beside its own.
            episodes: with truth.
        """
        layout, step = episodes[0].layout, step_s(episodes[0])
        told = run_contender(policy, policy.start(layout), episodes, shown=[PROBABILITY])
        other = run_contender(rival, rival.start(layout), episodes)
        error = {
            Path(one.name).name: np.linalg.norm(of["error"], axis=-1)
            for one, of in ((policy, told), (rival, other))
        }
        trusted = [(told["mode"] == i) * 1.0 for i in range(len(policy.actions))]
        probability = list(np.moveaxis(told[PROBABILITY], -1, 0))
        offsets = np.arange(-round(AROUND_S / step), round(AROUND_S / step) + 1)
        around = {
            kind: _around(Windows.around(find(episodes), offsets), trusted, probability, error)
            for kind, find in EVENTS.items()
        }
        return cls(policy.actions, np.asarray(offsets * step, np.float64), around)

    @property
    def json(self) -> dict[str, Any]:
        """As results files hold it; null where there is no epoch."""

        def number(value: float) -> float | None:
            return None if np.isnan(value) else float(value)

        def shares(names: list[str], table: Array) -> dict[str, list[float | None]]:
            return {name: [*map(number, row)] for name, row in zip(names, table, strict=True)}

        def intervals(row: list[Interval]) -> list[dict[str, Any]]:
            return [interval.json | {"mean": number(interval.mean)} for interval in row]

        content: dict[str, Any] = {"time_s": self.time_s.tolist()}
        for kind, one in self.around.items():
            content[kind] = {
                "events": one.events,
                "trusted": shares(self.actions, one.trusted),
                "probability": shares(self.actions[1:], one.probability),
                "error_m": {name: intervals(row) for name, row in one.error_m.items()},
                "gain_m": intervals(one.gain_m),
            }
        return content

    def __str__(self) -> str:
        """Around each kind of event: shares of whom is trusted, and errors."""
        name, rival = next(iter(self.around.values())).error_m
        header = ["event", "time s", *self.actions, f"error of {name} m", f"minus {rival} m"]
        rows = []
        for kind, one in self.around.items():
            for moment in MOMENTS_S:
                at = int(np.argmin(abs(self.time_s - moment)))
                shares = [f"{share:.2f}" for share in one.trusted[:, at]]
                when = f"{self.time_s[at]:+g}" if moment else "0"
                rows.append([kind, when, *shares, str(one.error_m[name][at]), str(one.gain_m[at])])
        return grid(header, rows)

    def draw(self, path: Path) -> None:
        """As a picture: trust, probabilities and errors, a column a kind of event."""
        shares = [
            Shares("share of decisions\nthat trust a mode", self.actions,
                   {kind: one.trusted for kind, one in self.around.items()}),
            Shares("mean probability of\nmodes before trust", self.actions[1:],
                   {kind: one.probability for kind, one in self.around.items()}),
        ]  # fmt: skip
        errors = {
            kind: {
                caption(name): np.transpose([(i.mean, i.low, i.high) for i in row])
                for name, row in one.error_m.items()
            }
            for kind, one in self.around.items()
        }
        events = {kind: one.events for kind, one in self.around.items()}
        lines = Lines("mean position\nerror (m)", errors)
        draw_around_events(self.time_s, events, shares, lines, path)


def _around(
    windows: Windows, trusted: list[Array], probability: list[Array], error: dict[str, Array]
) -> Around:
    """Means over epochs near events, of tables (n, T) each."""
    epochs = windows.sums(np.ones_like(trusted[0]))
    total = epochs.sum(axis=0)

    def means(tables: list[Array]) -> Array:
        sums = np.array([windows.sums(table).sum(axis=0) for table in tables])
        found = np.full(sums.shape, np.nan)
        np.divide(sums, total, out=found, where=total > 0.0)
        return found

    mine, others = (windows.sums(table) for table in error.values())
    both = [bootstrap_ratio(sums, epochs) for sums in (mine, others)]
    return Around(
        len(windows.place), means(trusted), means(probability),
        dict(zip(error, both, strict=True)), bootstrap_ratio(mine - others, epochs),
    )  # fmt: skip
