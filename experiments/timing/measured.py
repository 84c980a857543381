"""All measurements that the command ``mmwave-loc speed`` makes, in several rounds; their tables."""

import gc
import os
import platform
import re
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from decimal import Decimal
from pathlib import Path
from statistics import median
from typing import Any

import numba
import numpy as np

from experiments.console.output import grid, tracked
from experiments.timing.fresh import fresh
from experiments.timing.roofline import Operations, count, limit_s
from experiments.timing.workloads import (
    FILTERS,
    LATENCIES,
    PERCENTILES,
    RADIO,
    SYNC,
    SYNC_NAME,
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

FRESH_RUNS = 3  # maximum number of new processes per environment; each takes seconds
FRESH_SIZES = 3  # number of vector environments that also run in new processes: the largest ones
STEP = "step"  # name of the kernel (compiled function) that computes an environment's whole step
BASES = ("filterpy", SYNC_NAME)  # workloads with which our environments are compared

Rounds = dict[str, list[float]]


def rate(laps: Laps, seconds: float) -> tuple[float, float]:
    """Run complete episodes for at least ``seconds``, without garbage collection.

    Return the steps per second, and the number of busy cores (processor time / elapsed time).
    """
    gc.collect()
    gc.disable()
    busy = time.process_time()
    begin = time.perf_counter()
    steps = next(laps)
    while (spent := time.perf_counter() - begin) < seconds:
        steps += next(laps)
    cores = (time.process_time() - busy) / spent
    gc.enable()
    return steps / spent, cores


class Measured:
    """All measured values.

    ``sizes`` are the sizes of our vector environment (numbers of environments) to measure.

    Attributes:
        operations: operations of each kernel.
        rounds: lists, by quantity and name. A list has one value per round or, for new processes,
            per process. The quantities are "steps_per_s" and "cores_busy" of workloads;
            "latency_us", the time for an epoch of a live track; "limit_s", the minimum time for a
            step on one core, by kernel; and, of processes, "cold_start_s" (until the end of the
            first step) and "peak_rss_mb" (memory, MiB).
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
        processes = [("single", 0)]
        processes += [(native_name(n), n) for n in self.sizes[-FRESH_SIZES:]]
        for name, n in tracked(processes * min(FRESH_RUNS, repeats), "new processes"):
            first_step_s, peak_mb = fresh(n)
            rounds["cold_start_s"][name].append(first_step_s)
            rounds["peak_rss_mb"][name].append(peak_mb)
        running = {}
        makes = environments(self.sizes) | filters()
        for name in tracked(makes, "compilation"):
            running[name] = makes[name]()
            rate(running[name], seconds)  # the first run compiles
        for _ in tracked(range(repeats), "rounds"):
            for name, laps in running.items():
                steps_per_s, cores = rate(laps, seconds)
                rounds["steps_per_s"][name].append(steps_per_s)
                rounds["cores_busy"][name].append(cores)
            for name, interface in LATENCIES:
                for percentile, value in zip(PERCENTILES, latency_us(name, interface), strict=True):
                    rounds["latency_us"][f"{name} {interface}, p{percentile:g}"].append(value)
            for name, operations in self.operations.items():
                rounds["limit_s"][name].append(limit_s(operations) / WIDTH)

    @property
    def ours(self) -> list[str]:
        """Return names of our environments, the single environment first."""
        return [name for name in environments(self.sizes) if name not in BASES]

    def ratios(self) -> Rounds:
        """Return our steps per second divided by the rate of each workload in :data:`BASES`."""
        rates = self.rounds["steps_per_s"]
        return {
            f"{name}_over_{base}": np.divide(rates[name], rates[base]).tolist()
            for base in BASES
            for name in self.ours
        }

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
        """Return medians over the rounds and, under "spread", minima and maxima."""
        tables = {"ratios": self.ratios(), "limit_fraction": self.fractions(), **self.rounds}

        def each(figure: Callable[[list[float]], Any]) -> Json:
            return {
                title: {name: figure(values) for name, values in table.items()}
                for title, table in tables.items()
            }

        return {
            **each(median),
            "operations": {name: kernel._asdict() for name, kernel in self.operations.items()},
            "spread": each(lambda values: [min(values), max(values)]),
        }


def kernels() -> dict[str, Operations]:
    """Count the operations of each filter, and of an environment's step including the simulation.

    Rare events of the simulation (changes of gait, crossings) are left out.
    """
    task = task_from()
    drawn = task.simulated
    modes = named_modes(RADIO)
    programs = {STEP: Engine(task.pipeline, 1, TrackingReward()).program}
    for name in FILTERS:
        alone = untuned(Pipeline((modes[name],), task.pipeline.layout))
        programs[name] = program_of(Asked(alone, predicted=True), (filter_epoch, decide))
    counted = {name: count(made.function, made.template) for name, made in programs.items()}
    template = drawn.world.template
    observe, _, move = drawn.world.parts
    parts = [counted[STEP], count(observe, template)]
    parts += [count(move, template)] * stride_of(drawn.dt)
    return counted | {STEP: Operations(*map(sum, zip(*parts, strict=True)))}


LABELS = {
    "filterpy": "filterpy loop",
    "single": "single environment",
    SYNC_NAME: f"Gymnasium's sync vector of {SYNC}",
} | {name: name.upper() for name in FILTERS}


def label(name: str) -> str:
    """Return the name of a workload in tables and pictures."""
    if name in LABELS:
        return LABELS[name]
    kind, n, *threads = name.split("_")  # such as native_64_1_thread
    size = f"{kind}, N = {n}"
    return f"{size}, {' '.join(threads)}" if threads else size


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
    rates = rounds["steps_per_s"]
    ratios = measured.ratios()
    speeds = {n: [label(n), spread(each), short(1e9 / median(each))] for n, each in rates.items()}
    busy = [
        [*speeds[name], f"{median(cores):.2f}"]
        for name, cores in rounds["cores_busy"].items()
        if name not in FILTERS
    ]
    limits = []
    for name, fractions in measured.fractions().items():
        least = measured.limits_of(name)
        taken = np.divide(least, fractions).tolist()
        shown = (spread(least, 1e9), spread(taken, 1e9), spread(fractions, 100.0))
        limits.append([label(name), *shown])
    latencies = [
        [name, *(spread(rounds["latency_us"][f"{name}, p{p:g}"]) for p in PERCENTILES)]
        for name in map(" ".join, LATENCIES)
    ]

    def processes(quantity: str) -> list[list[str]]:
        return [[label(name), spread(values)] for name, values in rounds[quantity].items()]

    versions = (platform.python_version(), np.__version__, numba.__version__)
    machine = [_processor(), os.cpu_count(), *versions, len(rates["filterpy"])]
    return {
        "Ratios": grid(
            ["ratio of steps per second", *(f"to {label(base)}" for base in BASES)],
            [
                [label(name), *(spread(ratios[f"{name}_over_{base}"]) for base in BASES)]
                for name in measured.ours
            ],
        ),
        "Steps per second": grid(["", "steps per second", "ns per step", "cores busy"], busy),
        "Filters alone": grid(
            ["filter", "epochs per second", "ns per epoch"], [speeds[name] for name in FILTERS]
        ),
        "Limit of the core": grid(
            ["one thread", "limit, ns per step", "time taken, ns", "limit reached, %"], limits
        ),
        "Latency": grid(["one epoch", *(f"p{p:g}, microseconds" for p in PERCENTILES)], latencies),
        "Peak memory": grid(["fresh process", "peak memory, MiB"], processes("peak_rss_mb")),
        "First step": grid(
            ["fresh process", "seconds to the end of the first step"], processes("cold_start_s")
        ),
        "Machine": grid(
            ["processor", "processors", "Python", "numpy", "numba", "rounds"], [machine]
        ),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists() and (names := re.findall(r"model name\s*: (.*)", info.read_text())):
        return str(names[0])
    return platform.processor() or platform.machine()
