"""What policies choose around fast stops and pull-aways, and how far off everyone is there.

:mod:`experiments.evaluation.events` says which these are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.colors import COLORS, draw_shares
from experiments.evaluation.contenders import Contender
from experiments.evaluation.events import (
    Windows,
    fast_pull_aways,
    fast_stops,
    speeds,
    velocities,
)
from experiments.evaluation.runner import EpochResults, step_s
from mmwave_env.episodes.episode import Episode
from mmwave_env.files import atomic_path
from mmwave_env.numerics.arrays import Array

BEFORE_S, AFTER_S = 10.0, 20.0  # what is looked at
STYLES = ("-", "--", ":")  # where there are more lines than colors
LINE_INCHES = 0.22  # height of a line of the legend


EVENTS = {"stop": fast_stops, "pull-away": fast_pull_aways}


@dataclass
class Around:
    """Sums over events of one kind, per epoch (w,) around them."""

    events: int  # how many; those cut off at an end of their episode count where they are
    epochs: Array  # how many epochs are summed
    error_m: Array  # position errors
    chosen: Array  # (actions, w) how often each was chosen; (0, w) of those who do not decide

    def __add__(self, other: "Around") -> "Around":
        return Around(
            self.events + other.events, self.epochs + other.epochs,
            self.error_m + other.error_m, self.chosen + other.chosen,
        )  # fmt: skip

    def mean(self, of: Array) -> Array:
        """Means (..., w) of a sum, NaN where there is no epoch."""
        means = np.full(of.shape, np.nan)
        np.divide(of, self.epochs, out=means, where=self.epochs > 0.0)
        return means


@dataclass
class Decisions:
    """Contenders around every kind of event."""

    names: Mapping[str, str]  # in figures, by contender; of others nothing is taken
    actions: dict[str, list[str]] = field(default_factory=dict)  # of each policy that decides
    time_s: Array = field(default_factory=lambda: np.zeros(0))  # (w,) of epochs around an event
    # per kind of event and name
    around: dict[str, dict[str, Around]] = field(
        default_factory=lambda: {kind: {} for kind in EVENTS}
    )

    def add(self, contender: Contender, episodes: Sequence[Episode], told: EpochResults) -> None:
        """Take what a contender told of episodes with truth."""
        if contender.name not in self.names:
            return
        name, step = self.names[contender.name], step_s(episodes[0])
        actions: list[str] = []
        if "mode" in told and not contender.name.startswith(("fixed-", "random")):
            actions = self.actions[name] = contender.actions
        offsets = np.arange(-round(BEFORE_S / step), round(AFTER_S / step) + 1)
        self.time_s = np.asarray(offsets * step, np.float64)
        speed = speeds(velocities(episodes))
        error = np.linalg.norm(told["error"], axis=-1)
        for kind, find in EVENTS.items():
            windows = Windows.around(find(speed, step), offsets)
            chosen = [(told["mode"] == i) * 1.0 for i in range(len(actions))]
            epochs, errors, *shares = (
                windows.sums(values).sum(axis=0) for values in (np.ones_like(error), error, *chosen)
            )
            counts = np.array(shares).reshape(-1, len(offsets))
            found = Around(len(windows.place), epochs, errors, counts)
            before = self.around[kind].get(name)
            self.around[kind][name] = found if before is None else before + found

    @property
    def json(self) -> dict[str, Any]:
        """As results files hold it; null where there is no epoch."""

        def numbers(values: Array) -> list[float | None]:
            return [None if np.isnan(value) else float(value) for value in values]

        content: dict[str, Any] = {"time_s": self.time_s.tolist()}
        for kind, table in self.around.items():
            content[kind] = {
                "events": next(iter(table.values())).events,
                "error_m": {name: numbers(one.mean(one.error_m)) for name, one in table.items()},
                "share": {
                    name: dict(zip(actions, map(numbers, self._shares(kind, name)), strict=True))
                    for name, actions in self.actions.items()
                },
            }
        return content

    def _shares(self, kind: str, name: str) -> Array:
        """Of each action (actions, w)."""
        around = self.around[kind][name]
        return around.mean(around.chosen)

    def draw(self, path: Path) -> None:
        """As PNG: errors of all above the shares of modes, a column a kind of event."""
        from matplotlib.figure import Figure

        heights = [max(3.0, LINE_INCHES * len(self.around["stop"])), *[2.2] * len(self.actions)]
        figure = Figure(figsize=(11.0, sum(heights)), layout="constrained")
        panels = figure.subplots(
            len(heights), len(EVENTS), sharex=True, sharey="row", squeeze=False,
            height_ratios=heights,
        )  # fmt: skip
        for column, (kind, table) in zip(panels.T, self.around.items(), strict=True):
            self._draw_errors(column[0], kind, table)
            for axes, name in zip(column[1:], self.actions, strict=True):
                draw_shares(axes, self.time_s, self._shares(kind, name), self.actions[name])
            column[-1].set_xlabel(f"time since the {kind} (s)")
        for axes in panels[:, -1]:  # of shares in the order in which they lie
            axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False,
                        fontsize="small", reverse=axes is not panels[0, -1])  # fmt: skip
        panels[0, 0].set_ylabel("mean position error (m)")
        for axes, name in zip(panels[1:, 0], self.actions, strict=True):
            axes.set_ylabel(f"{Path(name).name}\nshare of modes")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=120)

    def _draw_errors(self, axes: Any, kind: str, table: Mapping[str, Around]) -> None:
        from matplotlib.ticker import LogLocator, NullFormatter

        for i, (name, around) in enumerate(table.items()):
            round_, color = divmod(i, len(COLORS))
            style = STYLES[round_ % len(STYLES)]
            axes.plot(self.time_s, around.mean(around.error_m), style, color=COLORS[color],
                      label=Path(name).name)  # fmt: skip
        axes.set(title=f"{next(iter(table.values())).events} {kind}s", yscale="log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.axvline(0.0, color="black", lw=0.8)
        axes.grid(alpha=0.3)
