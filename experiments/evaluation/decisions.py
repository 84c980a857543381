"""What policies choose around fast stops and pull-aways, and how far off everyone is there.

:mod:`experiments.evaluation.events` says which these are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.events import (
    Windows,
    fast_pull_aways,
    fast_stops,
    speeds,
    velocities,
)
from experiments.evaluation.intervals import bootstrap_ratio
from experiments.evaluation.runner import EpochResults, step_s
from mmwave_env.numerics.arrays import Array
from mmwave_env.world.episode import Episode

BEFORE_S, AFTER_S = 10.0, 20.0  # what is looked at
REFERENCES = ("speed-rule", "fixed-ukf")  # whom the others are compared with: the first there is
EVENTS = {"stop": fast_stops, "pull-away": fast_pull_aways}


@dataclass
class Around:
    """What happens around events of one kind, per epoch (w,) around them.

    Events of an episode may depend on each other, so that intervals are over episodes.
    """

    events: int  # how many; those cut off at an end of their episode count where they are
    epochs: Array  # (n, w) how many epochs are summed, per episode
    error_m: Array  # (n, w) sums of position errors
    chosen: Array  # (actions, w) how often each was chosen; (0, w) of those who do not decide

    def __add__(self, other: "Around") -> "Around":
        return Around(
            self.events + other.events,
            np.concatenate([self.epochs, other.epochs]),
            np.concatenate([self.error_m, other.error_m]),
            self.chosen + other.chosen,
        )

    def mean(self, of: Array) -> Array:
        """Means (..., w) of a sum, NaN where there is no epoch."""
        epochs = self.epochs.sum(axis=0)
        means = np.full(of.shape, np.nan)
        np.divide(of, epochs, out=means, where=epochs > 0.0)
        return means

    @property
    def mean_error_m(self) -> Array:
        """Mean position errors (w,)."""
        return self.mean(self.error_m.sum(axis=0))

    def minus(self, other: "Around") -> Array:
        """Differences of the mean position errors, and low and high ends of their 95 % (3, w)."""
        found = bootstrap_ratio(self.error_m - other.error_m, self.epochs)
        return np.array([(one.mean, one.low, one.high) for one in found]).T


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
        if "mode" in told and not contender.name.startswith("fixed-"):
            actions = self.actions[name] = contender.actions
        offsets = np.arange(-round(BEFORE_S / step), round(AFTER_S / step) + 1)
        self.time_s = np.asarray(offsets * step, np.float64)
        speed = speeds(velocities(episodes))
        error = np.linalg.norm(told["error"], axis=-1)
        for kind, find in EVENTS.items():
            windows = Windows.around(find(speed, step), offsets)
            chosen = [(told["mode"] == i) * 1.0 for i in range(len(actions))]
            shares = [windows.sums(values).sum(axis=0) for values in chosen]
            found = Around(
                len(windows.place), windows.sums(np.ones_like(error)), windows.sums(error),
                np.array(shares).reshape(-1, len(offsets)),
            )  # fmt: skip
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
                "error_m": {name: numbers(one.mean_error_m) for name, one in table.items()},
                "share": {
                    name: dict(zip(actions, map(numbers, self.shares(kind, name)), strict=True))
                    for name, actions in self.actions.items()
                },
                "minus": self.reference,
                "error_minus_m": {
                    name: dict(zip(("mean", "low", "high"), map(numbers, band), strict=True))
                    for name, band in self.minus(kind).items()
                },
            }
        return content

    @property
    def reference(self) -> str:
        """Whose errors are subtracted: the paper's rule, or the first that was asked for."""
        there = list(self.around["stop"])
        return next((name for name in REFERENCES if name in there), there[0])

    def minus(self, kind: str) -> dict[str, Array]:
        """Errors minus those of the reference (3, w), by who else there is: mean, low and high."""
        table = self.around[kind]
        reference = table[self.reference]
        return {n: one.minus(reference) for n, one in table.items() if one is not reference}

    def shares(self, kind: str, name: str) -> Array:
        """Of each action (actions, w)."""
        around = self.around[kind][name]
        return around.mean(around.chosen)
