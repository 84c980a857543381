"""Steps per second of workloads, measured in turns."""

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from experiments.speed.workloads import Laps


@dataclass
class Rates:
    """What a workload did, per round."""

    steps_per_s: list[float] = field(default_factory=list)  # with the ends of episodes
    # steps per second while no episode ends; empty where nobody tells
    between_ends: list[float] = field(default_factory=list)
    cores: list[float] = field(default_factory=list)  # seconds of processor per second

    def measure(self, laps: Laps, seconds: float) -> None:
        """Add a round: whole episodes, for at least that long, without garbage collection."""
        steps, spent = {True: 0, False: 0}, {True: 0.0, False: 0.0}
        gc.collect()
        gc.disable()
        busy, ends = time.process_time(), False
        while sum(spent.values()) < seconds or not ends:
            begin = time.perf_counter()
            lap = next(laps)
            ends = lap.ends
            spent[ends] += time.perf_counter() - begin
            steps[ends] += lap.steps
        total = sum(spent.values())
        self.cores.append((time.process_time() - busy) / total)
        gc.enable()
        self.steps_per_s.append(sum(steps.values()) / total)
        if steps[False]:
            self.between_ends.append(steps[False] / spent[False])


def started(make: Callable[[], Laps], seconds: float) -> Laps:
    """A workload after a turn that does not count: by then what it does often is compiled."""
    laps = make()
    Rates().measure(laps, seconds)
    return laps
