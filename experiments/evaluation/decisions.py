"""What policies choose around stops and pull-aways, and how far off everyone is there.

A user pulls away in the first epoch in which the true horizontal speed exceeds 0.5 m/s after
it has been below 0.3 m/s for 3 s (between the two, it may linger), if it exceeds 2 m/s within
5 s: so a pedestrian does not. A stop is the same backwards in time: the last epoch above
0.5 m/s. Truth is nothing that a policy changes, so all contenders have the same events.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import EpochResults, step_s
from mmwave_env.episodes.episode import Episode
from mmwave_env.files import atomic_path
from mmwave_env.metrics import BURN_IN
from mmwave_env.numerics.arrays import Array, Mask

STILL_MPS, MOVING_MPS, FAST_MPS = 0.3, 0.5, 2.0
STILL_S, FAST_S = 3.0, 5.0  # how long it stands, and how soon it is fast
BEFORE_S, AFTER_S = 10.0, 20.0  # what is looked at
COLORS = 10  # there are; more lines are dashed


def pull_aways(speed_mps: Array, step_s: float = 1.0) -> Mask:
    """Epochs (n, T) in which users pull away, from their true speeds (n, T)."""
    n, T = speed_mps.shape
    enough, soon = max(1, round(STILL_S / step_s)), round(FAST_S / step_s)
    still, stands = np.zeros(n, np.int64), np.zeros(n, bool)
    found = np.zeros((n, T), bool)
    for t, speed in enumerate(speed_mps.T):
        moves = speed > MOVING_MPS
        found[:, t] = stands & moves & (speed_mps[:, t : t + soon + 1] > FAST_MPS).any(axis=1)
        still = np.where(speed < STILL_MPS, still + 1, 0)
        stands = (stands & ~moves) | (still >= enough)
    return found


def stops(speed_mps: Array, step_s: float = 1.0) -> Mask:
    """Epochs (n, T) in which users come to a stop: a pull-away backwards in time."""
    return pull_aways(speed_mps[:, ::-1], step_s)[:, ::-1]


EVENTS = {"stop": stops, "pull-away": pull_aways}


def _speed(episode: Episode) -> Array:
    """True horizontal speed (T,), m/s."""
    episode.require_truth()
    velocity = np.asarray(episode.truth_velocity_mps)
    speed: Array = np.hypot(velocity[:, 0], velocity[:, 1])
    return speed


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
        speed = np.stack([_speed(episode) for episode in episodes])
        for kind, find in EVENTS.items():
            places, epochs = np.nonzero(find(speed, step))
            window = epochs[:, None] + offsets
            inside = (window >= BURN_IN) & (window < speed.shape[1])
            at = places[:, None], np.where(inside, window, 0)
            error = np.where(inside, np.linalg.norm(told["error"][at], axis=-1), 0.0)
            chosen = [((told["mode"][at] == i) & inside).sum(axis=0) for i in range(len(actions))]
            found = Around(
                len(epochs), inside.sum(axis=0).astype(float), error.sum(axis=0),
                np.array(chosen, float).reshape(-1, len(offsets)),
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

        rows = 1 + len(self.actions)
        figure = Figure(figsize=(11.0, 3.0 + 2.2 * len(self.actions)), layout="constrained")
        panels = figure.subplots(rows, len(EVENTS), sharex=True, sharey="row", squeeze=False)
        for column, (kind, table) in zip(panels.T, self.around.items(), strict=True):
            self._draw_errors(column[0], kind, table)
            for axes, name in zip(column[1:], self.actions, strict=True):
                self._draw_shares(axes, kind, name)
            column[-1].set_xlabel(f"time since the {kind} (s)")
        for axes in panels[:, -1]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False,
                        fontsize="small")  # fmt: skip
        panels[0, 0].set_ylabel("mean position error (m)")
        for axes, name in zip(panels[1:, 0], self.actions, strict=True):
            axes.set_ylabel(f"{Path(name).name}\nshare of modes")
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=120)

    def _draw_errors(self, axes: Any, kind: str, table: Mapping[str, Around]) -> None:
        from matplotlib.ticker import LogLocator, NullFormatter

        for i, (name, around) in enumerate(table.items()):
            style = "-" if i < COLORS else "--"
            axes.plot(self.time_s, around.mean(around.error_m), style, label=Path(name).name)
        axes.set(title=f"{next(iter(table.values())).events} {kind}s", yscale="log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.axvline(0.0, color="black", lw=0.8)
        axes.grid(alpha=0.3)

    def _draw_shares(self, axes: Any, kind: str, name: str) -> None:
        axes.stackplot(self.time_s, self._shares(kind, name), labels=self.actions[name])
        axes.axvline(0.0, color="black", lw=0.8)
        axes.set_ylim(0.0, 1.0)
        axes.margins(x=0.0)
