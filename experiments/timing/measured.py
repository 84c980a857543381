"""All measurements that the command ``mmwave-loc speed`` makes, in several rounds; their tables."""

import gc
import time
from collections import defaultdict
from collections.abc import Sequence
from decimal import Decimal
from statistics import median

import numpy as np

from experiments.console.output import grid, tracked
from experiments.timing.roofline import Operations, count, limit_s
from experiments.timing.workloads import (
    FILTERPY,
    FILTERS,
    LATENCIES,
    PERCENTILES,
    RADIO,
    Laps,
    environments,
    filters,
    latency_us,
    native_name,
)
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.epoch import Asked, decide, filter_epoch, program_of, untuned
from mmwave_env.filters.bank import named_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.io.files import Json
from mmwave_env.task import task_from
from mmwave_env.world.travel import stride_of

STEP = "step"  # name of the kernel (compiled function) that computes an environment's whole step

Rounds = dict[str, list[float]]


def rate(laps: Laps, seconds: float) -> float:
    """Run complete episodes for at least ``seconds``, without garbage collection.

    Return the steps per second.
    """
    gc.collect()
    gc.disable()
    begin = time.perf_counter()
    steps = next(laps)
    while (spent := time.perf_counter() - begin) < seconds:
        steps += next(laps)
    gc.enable()
    return steps / spent


class Measured:
    """All measured values.

    ``sizes`` are the sizes of our vector environment (numbers of environments) to measure.

    Attributes:
        operations: operations of each kernel.
        rounds: lists, by quantity and name; a list has one value per round. The quantities are
            "steps_per_s" of workloads; "latency_us", the time for an epoch of a live track; and
            "limit_s", the minimum time for a step on one core, by kernel.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = sorted(set(sizes))
        self.operations = kernels()
        self.rounds: dict[str, Rounds] = defaultdict(lambda: defaultdict(list))

    def measure(self, seconds: float, repeats: int) -> None:
        """Measure everything in several rounds; a rate is measured for at least ``seconds``.

        Every round runs all workloads, so a drift of the machine's speed affects them equally.
        """
        rounds = self.rounds
        running = {}
        makes = environments(self.sizes) | filters()
        for name in tracked(makes, "compilation"):
            running[name] = makes[name]()
            rate(running[name], seconds)  # the first run compiles
        for _ in tracked(range(repeats), "rounds"):
            for name, laps in running.items():
                rounds["steps_per_s"][name].append(rate(laps, seconds))
            for name in LATENCIES:
                for percentile, value in zip(PERCENTILES, latency_us(name), strict=True):
                    rounds["latency_us"][f"{name}, p{percentile:g}"].append(value)
            for name, operations in self.operations.items():
                rounds["limit_s"][name].append(limit_s(operations) / WIDTH)

    @property
    def ours(self) -> list[str]:
        """Return names of our environments, the single environment first."""
        return [name for name in environments(self.sizes) if name != FILTERPY]

    def ratios(self) -> Rounds:
        """Return our steps per second divided by those of the loop over filterpy's filters."""
        rates = self.rounds["steps_per_s"]
        return {name: np.divide(rates[name], rates[FILTERPY]).tolist() for name in self.ours}

    def fractions(self) -> Rounds:
        """Return the minimum time of a step on a core, divided by the measured time of the step."""
        alone = [native_name(n, 1) for n in self.sizes]
        rates = self.rounds["steps_per_s"]
        return {
            name: np.multiply(self.limits_of(name), rates[name]).tolist()
            for name in (*FILTERS, *alone)
        }

    def limits_of(self, name: str) -> list[float]:
        """Return the minimum time of a workload's step on one core, s, per round."""
        return self.rounds["limit_s"][name if name in FILTERS else STEP]

    def json(self) -> Json:
        """Return all values, one per round, and the operations of each kernel."""
        operations = {name: kernel._asdict() for name, kernel in self.operations.items()}
        computed = {"ratios": self.ratios(), "limit_fraction": self.fractions()}
        return computed | self.rounds | {"operations": operations}


def kernels() -> dict[str, Operations]:
    """Count the operations of each filter, and of an environment's step including the simulation.

    Rare events of the simulation (changes of gait, crossings) are left out.
    """
    task = task_from()
    drawn = task.simulated
    modes = named_modes(RADIO)
    programs = {STEP: Engine(task.pipeline, 1, TrackingReward()).program}
    for name in FILTERS:
        alone = untuned(Pipeline((modes[name.lower()],), task.pipeline.layout))
        programs[name] = program_of(Asked(alone, predicted=True), (filter_epoch, decide))
    counted = {name: count(made.function, made.template) for name, made in programs.items()}
    template = drawn.world.template
    observe, _, move = drawn.world.parts
    parts = [counted[STEP], count(observe, template)]
    parts += [count(move, template)] * stride_of(drawn.dt)
    return counted | {STEP: Operations(*map(sum, zip(*parts, strict=True)))}


def short(value: float) -> str:
    """Format a number to three digits."""
    return f"{Decimal(f'{value:#.3g}'):,f}"


def spread(values: Sequence[float], unit: float = 1.0) -> str:
    """Format values times ``unit`` as their median and range; a single value has no range."""
    values = [value * unit for value in values]
    if len(values) == 1:
        return short(values[0])
    return f"{short(median(values))} ({short(min(values))} to {short(max(values))})"


def tables_of(measured: Measured) -> dict[str, str]:
    """Return all tables as Markdown, by title, the ratios first."""
    rounds = measured.rounds
    limits = []
    for name, fractions in measured.fractions().items():
        least = measured.limits_of(name)
        taken = np.divide(least, fractions).tolist()
        shown = (spread(least, 1e9), spread(taken, 1e9), spread(fractions, 100.0))
        limits.append([name, *shown])
    return {
        "Ratios": grid(
            ["ratio of steps per second", f"to {FILTERPY}"],
            [[name, spread(ratios)] for name, ratios in measured.ratios().items()],
        ),
        "Steps per second": grid(
            ["", "steps per second", "ns per step"],
            [
                [name, spread(rates), short(1e9 / median(rates))]
                for name, rates in rounds["steps_per_s"].items()
            ],
        ),
        "Limit of the core": grid(
            ["one thread", "limit, ns per step", "time taken, ns", "limit reached, %"], limits
        ),
        "Latency": grid(
            ["one epoch", *(f"p{p:g}, microseconds" for p in PERCENTILES)],
            [
                [name, *(spread(rounds["latency_us"][f"{name}, p{p:g}"]) for p in PERCENTILES)]
                for name in LATENCIES
            ],
        ),
    }
