"""mmwave-loc soak: many steps of all modes on damaged data, with every number checked.

Users and radios of every kind take turns. A batch of episodes is drawn once and run several
times, with other damage and other actions, which depend on the seed and the run alone, so that
--seed and --num-envs bring every run back.
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import cycle, product

import numpy as np
from numpy.typing import NDArray

from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.seeds import draw_episodes
from experiments.evaluation.terminal import progress, say
from experiments.reliability.arguments.soak import Args
from experiments.reliability.damage import damaged
from mmwave_env.engines.env_engine import Engine
from mmwave_env.episodes.episode import Episode
from mmwave_env.episodes.mobility import MOBILITIES
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import write_json
from mmwave_env.filters.mode_files import named_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.measurement import Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import scene_from
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.linalg import cholesky, unpack
from mmwave_env.reward import TrackingReward

RUNS = 8  # of a batch of episodes, which take longer to draw than to run
SHOWN = 3  # violations on the terminal
STAY = (0.0, 0.95, 1.0)  # probabilities of keeping the mode; an environment has one of them


@dataclass
class Tally:
    """What happened."""

    # steps, episodes, drawn: steps and episodes run, and how many of these were drawn anew
    steps: int = 0
    episodes: int = 0
    drawn: int = 0
    damage: dict[str, int] = field(default_factory=dict)  # what was done to the data, and how often
    # links, missing: links over all epochs loaded, and those of them with nothing to use
    links: int = 0
    missing: int = 0
    smallest_pivot: float = 1.0  # of P, over the variance it belongs to; 0 is singular
    largest_error_m: float = 0.0  # of the position
    # environments with a number that is not sound; the first ends the soak
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0  # how long it took

    def loaded(self, episodes: list[Episode], damage: dict[str, int]) -> None:
        """Count episodes about to be run."""
        self.episodes += len(episodes)
        self.damage = {what: self.damage.get(what, 0) + n for what, n in damage.items()}
        for episode in episodes:
            links = episode.usable[:, : episode.layout.anchors]
            self.links += links.size
            self.missing += links.size - int(links.sum())

    def __str__(self) -> str:
        lines = [
            f"{self.steps:,} steps in {self.episodes:,} episodes ({self.drawn:,} drawn, each run "
            f"{self.episodes / self.drawn:.3g} times with other damage and actions)",
            f"{self.missing / self.links:.1%} of {self.links:,} links missing; done to the data:",
            *(f"  {times:14,} {what}" for what, times in self.damage.items()),
            f"smallest pivot of P over its variance: {self.smallest_pivot:.3g}",
            f"largest position error: {self.largest_error_m:.4g} m",
            f"{self.seconds:.0f} s; violations: {len(self.violations)}",
            *self.violations[:SHOWN],
        ]
        return "\n".join(lines)


def runs(
    args: Args, tally: Tally
) -> Iterator[tuple[str, range, list[Episode], np.random.Generator]]:
    """Episodes of every kind of user and radio in turn, RUNS times each batch.

    Yields:
        A name for messages; seeds of the episodes; these, undamaged; what draws the rest.
    """
    kinds = cycle(product(MOBILITIES, RADIOS.values()))
    for turn, (scenario, radio) in enumerate(kinds):
        first = args.seed + turn * args.num_envs
        seeds = range(first, first + args.num_envs)
        source = SimulatedSource(scene_from("street"), radio, scenario)
        episodes = draw_episodes(source, seeds)
        tally.drawn += len(episodes)
        for number in range(turn * RUNS, (turn + 1) * RUNS):
            name = f"run {number} (scenario {scenario}, radio {radio.name})"
            yield name, seeds, episodes, np.random.default_rng([args.seed, number])


class Watch:
    """Looks at the numbers of an engine.

    Args:
        engine: what to look at.
    """

    def __init__(self, engine: Engine) -> None:
        self.read = engine.read
        names = ("x", "P", "memory", "candidates", "observation", "reward", "nees", "distance")
        self._parts = {name: getattr(engine.at, name) for name in names}
        for name, part in self._parts.items():
            if not isinstance(part, int):
                self._parts[name] = engine.span(part)

    def infinite(self) -> dict[str, NDArray[np.bool_]]:
        """Which environments (n,) have a number that is not finite, for each kind of numbers."""
        found = {}
        for name, part in self._parts.items():
            wrong = ~np.isfinite(self.read(part))
            found[name] = wrong.any(axis=1) if wrong.ndim > 1 else wrong
        return found

    def pivots(self) -> Array:
        """The smallest pivot of each P, over its variance (n,): positive if P is definite.

        It is the share of a variance that the components before it do not explain; NaN where
        P is not positive definite.
        """
        P = unpack(list(np.ascontiguousarray(self.read(self._parts["P"]).T)))
        with np.errstate(invalid="ignore", divide="ignore"):
            factor = cholesky(P)
            shares = [factor[i][i] ** 2 / P[i][i] for i in range(len(P))]
        smallest: Array = np.min(shares, axis=0)
        return smallest

    def values(self, place: int) -> str:
        """The belief of an environment."""
        x, P = (self.read(self._parts[name])[place].tolist() for name in ("x", "P"))
        return f"x = {x}, lower triangle of P = {P}"


def soak(args: Args, tally: Tally, show: Callable[[float], None]) -> None:
    """Run until enough steps are done, or a number is not sound."""
    modes, n = tuple(named_modes().values()), args.num_envs
    engine = Engine(Pipeline(modes, Layout(3)), n, TrackingReward())
    watch = Watch(engine)
    for name, seeds, drawn, rng in runs(args, tally):
        episodes, damage = damaged(drawn, rng)
        tally.loaded(episodes, damage)
        engine.reset(episodes)
        actions, stay = rng.integers(len(modes), size=n), rng.choice(STAY, n)
        for epoch in range(len(episodes[0])):
            engine.step(actions)
            tally.steps += n
            smallest, distance = watch.pivots(), engine.read(engine.at.distance)
            unsound = watch.infinite() | {"pivots of P": ~(smallest > 0.0)}
            for place in np.flatnonzero(np.any(list(unsound.values()), axis=0)).tolist():
                wrong = ", ".join(kind for kind, where in unsound.items() if where[place])
                tally.violations.append(
                    f"{name}, epoch {epoch}, environment {place} (seed {seeds[place]}), mode "
                    f"{modes[actions[place]].name}, unsound {wrong}: {watch.values(place)}"
                )
            if tally.violations:
                return
            tally.smallest_pivot = min(tally.smallest_pivot, float(smallest.min()))
            tally.largest_error_m = max(tally.largest_error_m, float(distance.max()))
            if tally.steps >= args.steps:
                return
            changed = rng.random(n) >= stay
            actions = np.where(changed, rng.integers(len(modes), size=n), actions)
        show(tally.steps / args.steps)


def main(args: Args) -> None:
    """Run the command."""
    for name, found in (("steps", args.steps), ("num-envs", args.num_envs)):
        if not 1 <= found < float("inf"):
            raise ValueError(f"{name}: found {found:g}, expected at least 1")
    tally, begin = Tally(), time.perf_counter()
    with progress("soaking") as show:
        soak(args, tally, show)
    tally.seconds = time.perf_counter() - begin
    say(*str(tally).split("\n"))
    if args.json:
        what = {"steps": args.steps, "seed": args.seed, "num_envs": args.num_envs}
        made = provenance("soak", args)
        write_json(args.json, made | {"asked": what, "found": asdict(tally)})
    if tally.violations:
        sys.exit(1)


if __name__ == "__main__":
    run("soak")
