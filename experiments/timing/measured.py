"""All measurements of mmwave-loc speed, made in several rounds."""

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from experiments.timing import workloads
from experiments.timing.fresh import fresh
from experiments.timing.latency import LATENCIES, PERCENTILES, latency_us
from experiments.timing.operations import Operations, count
from experiments.timing.roofline import limit_s
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.bank import named_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.world.travel import stride_of

FRESH_RUNS = 3  # maximum number of runs in new processes, since each takes seconds
FRESH_SIZES = 3  # number of vector environments, the largest, that also run in new processes
STEP = "step"  # name of the kernel that makes a complete step of the environment
BASES = ("filterpy", workloads.SYNC_NAME)  # workloads with which ours are compared

Rounds = dict[str, list[float]]


@dataclass
class Rates:
    """The rates of a workload, one per round."""

    steps_per_s: list[float] = field(default_factory=list)
    cores: list[float] = field(default_factory=list)  # processor time per elapsed time

    def measure(self, laps: workloads.Laps, seconds: float) -> None:
        """Run complete episodes for at least ``seconds``, without garbage collection; add rates."""
        gc.collect()
        gc.disable()
        busy, begin = time.process_time(), time.perf_counter()
        steps = next(laps)
        while (spent := time.perf_counter() - begin) < seconds:
            steps += next(laps)
        self.cores.append((time.process_time() - busy) / spent)
        gc.enable()
        self.steps_per_s.append(steps / spent)


class Measured:
    """All measured values; each list has one entry per round or, for new processes, per process.

    ``sizes`` are numbers of environments in the native vector environment.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = sorted(set(sizes))
        self.rates = {name: Rates() for name in workloads.environments(self.sizes)}
        # rates of the filters without an environment, on one thread
        self.filters = {name: Rates() for name in workloads.FILTERS}
        self.operations = kernels()
        # minimum time of a step of each kernel on one core
        self.limits_s: Rounds = {name: [] for name in self.operations}
        # microseconds per live epoch, by contender, interface and percentile
        self.latency_us: Rounds = {
            f"{' '.join(of)}, p{p:g}": [] for of in LATENCIES for p in PERCENTILES
        }
        largest = {workloads.native_name(n): n for n in self.sizes[-FRESH_SIZES:]}
        self._processes = {"single": 0} | largest
        # seconds from the start of a process to the end of its first step; peak memory, MiB
        self.cold_start_s: Rounds = {name: [] for name in self._processes}
        self.peak_mb: Rounds = {name: [] for name in self._processes}

    def run(self, seconds: float, repeats: int) -> Iterator[float]:
        """Run all measurements; yield the share that is done after each.

        Every round runs each workload once, so a drift of the machine's speed affects all equally.
        """
        starts, workloads = min(FRESH_RUNS, repeats), len(self.rates) + len(self.filters)
        pieces = starts * len(self._processes) + workloads
        pieces += repeats * (workloads + len(LATENCIES) + 1)
        for done, _ in enumerate(self._pieces(seconds, repeats, starts), start=1):
            yield done / pieces

    def _pieces(self, seconds: float, repeats: int, starts: int) -> Iterator[None]:
        for _ in range(starts):
            for name, n in self._processes.items():
                first_step_s, peak_mb = fresh(workloads.ENVIRONMENT, n)
                self.cold_start_s[name].append(first_step_s)
                self.peak_mb[name].append(peak_mb)
                yield
        running = {}
        for name, make in (workloads.environments(self.sizes) | workloads.filters()).items():
            running[name] = make()
            Rates().measure(running[name], seconds)  # a warm-up, which compiles
            yield
        rates = self.rates | self.filters
        for _ in range(repeats):
            for name, laps in running.items():
                rates[name].measure(laps, seconds)
                yield
            for of in LATENCIES:
                for percentile, value in zip(PERCENTILES, latency_us(*of), strict=True):
                    self.latency_us[f"{' '.join(of)}, p{percentile:g}"].append(value)
                yield
            for name, operations in self.operations.items():
                self.limits_s[name].append(limit_s(operations) / WIDTH)
            yield

    def natives(self, threads: int = workloads.BOTH) -> list[str]:
        """Return names of our vector environments ("native") with ``threads`` threads."""
        return [workloads.native_name(n, threads) for n in self.sizes]

    @property
    def ours(self) -> list[str]:
        """Return names of our environments, the single one first."""
        return ["single"] + [n for threads in workloads.THREADS for n in self.natives(threads)]

    def ratios(self) -> Rounds:
        """Return ratios of our steps per second to those of the workloads in :data:`BASES`."""
        return {
            f"{name}_over_{base}": np.divide(
                self.rates[name].steps_per_s, self.rates[base].steps_per_s
            ).tolist()
            for base in BASES
            for name in self.ours
        }

    def fractions(self) -> Rounds:
        """Return the minimum time of a step on a core, divided by the measured time of the step."""
        workloads = self.filters | {name: self.rates[name] for name in self.natives(1)}
        return {
            name: np.multiply(self.limits_of(name), rates.steps_per_s).tolist()
            for name, rates in workloads.items()
        }

    def limits_of(self, name: str) -> list[float]:
        """Return the minimum time of a workload's step on one core, s, per round."""
        return self.limits_s[name if name in self.filters else STEP]

    def json(self) -> dict[str, Any]:
        """Return medians over the rounds and, under "spread", minima and maxima."""
        rates = self.rates | self.filters
        tables: dict[str, Rounds] = {
            "ratios": self.ratios(),
            "limit_fraction": self.fractions(),
            "steps_per_s": {name: rate.steps_per_s for name, rate in rates.items()},
            "latency_us": self.latency_us,
            "cold_start_s": self.cold_start_s,
            "peak_rss_mb": self.peak_mb,
            "cores_busy": {name: rate.cores for name, rate in rates.items()},
            "limit_s": self.limits_s,
        }

        def each(figure: Callable[[list[float]], Any]) -> dict[str, Any]:
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
    """Count the operations of each filter, and of an environment's step with its simulation.

    Rare events of the simulation (changes of gait, crossings) are left out.
    """
    pipeline, drawn = workloads.pipeline(), workloads.source()
    layout, modes = pipeline.layout, named_modes(workloads.RADIO)
    programs: dict[str, Any] = {
        name: Tracker(Pipeline((modes[name],), layout), 1).program for name in workloads.FILTERS
    }
    programs[STEP] = Engine(pipeline, 1, TrackingReward()).batch.program
    counted = {name: count(made.function, made.template) for name, made in programs.items()}
    observed, _, moved = (count(part, drawn.world.template) for part in drawn.world.parts)
    parts = zip(counted[STEP], observed, *[moved] * stride_of(drawn.dt), strict=True)
    return counted | {STEP: Operations(*map(sum, parts))}
