"""Markdown tables of the speed measurements."""

import os
import platform
import re
from collections.abc import Callable, Sequence
from decimal import Decimal
from pathlib import Path
from statistics import median

import numba
import numpy as np

from experiments.console.tables import grid
from experiments.timing.latency import LATENCIES, PERCENTILES
from experiments.timing.measured import BASES, Measured, Rounds
from experiments.timing.workloads import FILTERS, SYNC, SYNC_NAME

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


def _ratios(measured: Measured) -> str:
    ratios = measured.ratios()
    rows = [
        [label(name), *(spread(ratios[f"{name}_over_{base}"]) for base in BASES)]
        for name in measured.ours
    ]
    return grid(["ratio of steps per second", *(f"to {label(base)}" for base in BASES)], rows)


def _rate(measured: Measured, name: str) -> list[str]:
    rates = measured.steps_per_s[name]
    return [label(name), spread(rates), short(1e9 / median(rates))]


def _rates(measured: Measured) -> str:
    rows = [
        [*_rate(measured, name), f"{median(cores):.2f}"]
        for name, cores in measured.cores_busy.items()
        if name not in FILTERS
    ]
    return grid(["", "steps per second", "ns per step", "cores busy"], rows)


def _filters(measured: Measured) -> str:
    rows = [_rate(measured, name) for name in FILTERS]
    return grid(["filter", "epochs per second", "ns per epoch"], rows)


def _limits(measured: Measured) -> str:
    rows = []
    for name, fractions in measured.fractions().items():
        limits = measured.limits_of(name)
        taken = np.divide(limits, fractions).tolist()
        shown = (spread(limits, 1e9), spread(taken, 1e9), spread(fractions, 100.0))
        rows.append([label(name), *shown])
    return grid(["one thread", "limit, ns per step", "time taken, ns", "limit reached, %"], rows)


def _latency(measured: Measured) -> str:
    times = measured.latency_us
    names = [" ".join(latency) for latency in LATENCIES]
    rows = [[name, *(spread(times[f"{name}, p{p:g}"]) for p in PERCENTILES)] for name in names]
    return grid(["one epoch", *(f"p{p:g}, microseconds" for p in PERCENTILES)], rows)


def _processes(header: str, rounds: Rounds) -> str:
    rows = [[label(name), spread(values)] for name, values in rounds.items()]
    return grid(["fresh process", header], rows)


def _machine(measured: Measured) -> str:
    header = ["processor", "processors", "Python", "numpy", "numba", "rounds"]
    versions = (platform.python_version(), np.__version__, numba.__version__)
    rounds = len(measured.steps_per_s["filterpy"])
    return grid(header, [[_processor(), os.cpu_count(), *versions, rounds]])


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists() and (names := re.findall(r"model name\s*: (.*)", info.read_text())):
        return str(names[0])
    return platform.processor() or platform.machine()


# title -> function that makes the table, the ratios first
TABLES: dict[str, Callable[[Measured], str]] = {
    "Ratios": _ratios,
    "Steps per second": _rates,
    "Filters alone": _filters,
    "Limit of the core": _limits,
    "Latency": _latency,
    "Peak memory": lambda m: _processes("peak memory, MiB", m.peak_mb),
    "First step": lambda m: _processes("seconds to the end of the first step", m.cold_start_s),
    "Machine": _machine,
}
