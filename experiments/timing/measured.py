"""All measurements that the command ``mmwave-loc speed`` makes, in several rounds; their tables."""

import gc
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from decimal import Decimal
from statistics import median

import numpy as np

from experiments.console.output import grid, tracked
from experiments.timing.roofline import Operations, count, limit_s
from experiments.timing.workloads import (
    ALONE,
    FILTERPY,
    FILTERS,
    LATENCIES,
    PERCENTILES,
    RADIO,
    Laps,
    environments,
    filters,
    latency_us,
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


def measured(sizes: Sequence[int], seconds: float, repeats: int) -> Json:
    """Measure everything in several rounds; a rate is measured for at least ``seconds``.

    Every round runs all workloads, so a drift of the machine's speed affects them equally.

    Args:
        sizes: sizes of our vector environment (numbers of environments) to measure.
        seconds: minimum time of a measurement.
        repeats: number of rounds.

    Returns:
        What :func:`compared` returns, and the "operations" of each kernel.
    """
    operations = kernels()
    rounds: dict[str, Rounds] = defaultdict(lambda: defaultdict(list))
    running = {}
    makes = environments(sorted(set(sizes))) | filters()
    for name in tracked(makes, "compilation"):
        running[name] = makes[name]()
        rate(running[name], seconds)  # the first run compiles
    for _ in tracked(range(repeats), "rounds"):
        for name, laps in running.items():
            rounds["steps_per_s"][name].append(rate(laps, seconds))
        for name in LATENCIES:
            for percentile, value in zip(PERCENTILES, latency_us(name), strict=True):
                rounds["latency_us"][f"{name}, p{percentile:g}"].append(value)
        for name, kernel in operations.items():
            rounds["limit_s"][name].append(limit_s(kernel) / WIDTH)
    counted = {name: kernel._asdict() for name, kernel in operations.items()}
    return compared(rounds) | {"operations": counted}


def compared(rounds: Mapping[str, Rounds]) -> Json:
    """Return measured values with their comparisons, all as lists with a value for each round.

    Args:
        rounds: "steps_per_s" of workloads; "latency_us", the time for an epoch of a live track;
            and "limit_s", the minimum time for a step on one core, by kernel.

    Returns:
        The rounds; "ratios" of our steps per second to those of the loop over filterpy's filters;
        and "limit_fraction", the minimum time of a step on one core divided by its measured time.
    """
    rates = rounds["steps_per_s"]
    limits = rounds["limit_s"]
    ours = [name for name in rates if name not in (FILTERPY, *FILTERS)]
    alone = (*FILTERS, *(name for name in ours if name.endswith(ALONE)))
    ratios = {name: np.divide(rates[name], rates[FILTERPY]).tolist() for name in ours}
    fractions = {
        name: np.multiply(limits.get(name, limits[STEP]), rates[name]).tolist() for name in alone
    }
    return {"ratios": ratios, "limit_fraction": fractions} | dict(rounds)


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


def tables_of(figures: Json) -> dict[str, str]:
    """Return all tables as Markdown, by title, the ratios first."""
    rates = figures["steps_per_s"]
    limits = figures["limit_s"]
    reached = []
    for name, fractions in figures["limit_fraction"].items():
        least = limits.get(name, limits[STEP])
        taken = np.divide(1.0, rates[name]).tolist()
        shown = (spread(least, 1e9), spread(taken, 1e9), spread(fractions, 100.0))
        reached.append([name, *shown])
    return {
        "Ratios": grid(
            ["ratio of steps per second", f"to {FILTERPY}"],
            [[name, spread(ratios)] for name, ratios in figures["ratios"].items()],
        ),
        "Steps per second": grid(
            ["", "steps per second", "ns per step"],
            [[name, spread(each), short(1e9 / median(each))] for name, each in rates.items()],
        ),
        "Limit of the core": grid(
            ["one thread", "limit, ns per step", "time taken, ns", "limit reached, %"], reached
        ),
        "Latency": grid(
            ["one epoch", *(f"p{p:g}, microseconds" for p in PERCENTILES)],
            [
                [name, *(spread(figures["latency_us"][f"{name}, p{p:g}"]) for p in PERCENTILES)]
                for name in LATENCIES
            ],
        ),
    }
