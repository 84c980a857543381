"""mmwave-loc benchmark: steps per second beside filterpy's, as ratios within one run.

The filterpy loop does what a step needs and nothing more: both modes' predictions, gates and
updates on filterpy's filters, and the reward of the chosen one. Absolute figures depend on
the machine; ratios much less.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.progress import track

from experiments.cli import run
from experiments.evaluation import draw_episodes
from experiments.files import write_json
from mmwave_env.engine import Engine
from mmwave_env.episode import Episode
from mmwave_env.estimator.algebra import unpack
from mmwave_env.estimator.batch import blank_incoming, blank_site
from mmwave_env.estimator.belief import Belief
from mmwave_env.estimator.filterpy_twin import filterpy_pipeline
from mmwave_env.estimator.modes import default_modes
from mmwave_env.estimator.pipeline import Pipeline, measurement_of, process_noise, start
from mmwave_env.estimator.trees import rebuild
from mmwave_env.estimator.update import Gate
from mmwave_env.radio import radio_from
from mmwave_env.reward import TrackingReward
from mmwave_env.scene import scene_from
from mmwave_env.simulation import SimulatedSource


@dataclass
class Args:
    """Measure steps per second, the same work side by side."""

    seconds: float = 2.0
    """time per measurement"""
    repeats: int = 3
    """measurements of each kind, taken in turn; medians are printed"""
    batch: int = 1024
    """environments in the batched engine"""
    json: Path | None = None
    """write every figure to this file"""


def filterpy_steps(pipeline: Pipeline, episodes: list[Episode]) -> Iterator[int]:
    """Steps of a loop on filterpy's filters: both modes considered, the second one kept.

    Measurements and process noise are made ready beforehand: the loop is filterpy's alone.
    """
    twin, reward, memory = filterpy_pipeline(pipeline), TrackingReward(), start(pipeline)
    layout, gate = pipeline.layout, Gate(0.99)
    runs = []
    for episode in episodes:
        site = rebuild(blank_site(layout), iter(episode.site().tolist()))
        epochs = []
        for row in episode.table().tolist():
            incoming = rebuild(blank_incoming(layout), iter(row))
            epoch = incoming.epoch(layout)
            work = [
                (
                    mode,
                    process_noise(mode.tuning, epoch, site.hz_per_mps, 1.0, False),
                    measurement_of(mode, memory, epoch, site, layout),
                )
                for mode in pipeline.modes
            ]
            epochs.append((epoch.dt, incoming.truth, work))
        runs.append((site, epochs))
    while True:
        for site, epochs in runs:
            x, P = site.prior_x, unpack(site.prior_P)
            for dt, truth, work in epochs:
                for mode, noise, measurement in work:
                    prior = twin.predict(mode, x, P, noise, dt)
                    posterior = twin.update(mode)(*prior, measurement, gate)
                x, P = posterior.x, posterior.P
                reward(Belief(x, P), truth)
                yield 1


def env_steps(**options: Any) -> Iterator[int]:
    """Steps of the environment, episodes drawn as it goes."""
    env = gym.make("mmwave_env:MmWaveLoc-v0", **options).unwrapped
    action = np.int64(1)
    for seed in iter(int, 1):
        env.reset(seed=seed)
        over = False
        while not over:
            over = env.step(action)[3]
            yield 1


def engine_steps(pipeline: Pipeline, episodes: list[Episode]) -> Iterator[int]:
    """Steps of the batched engine; episodes are drawn beforehand."""
    engine = Engine(pipeline, len(episodes), TrackingReward())
    actions = np.ones(len(episodes), np.int64)
    while True:
        engine.reset(episodes)
        for _ in range(len(episodes[0])):
            engine.step(actions)
            engine.observations()
            yield len(episodes)


def rate(steps: Iterator[int], seconds: float) -> float:
    """Steps per second of an iterator of steps."""
    done, begin = 0, time.perf_counter()
    while (now := time.perf_counter()) - begin < seconds:
        done += next(steps)
    return done / (now - begin)


def main(args: Args) -> None:
    """Run the command."""
    source = SimulatedSource(scene_from("street"), radio_from("handset"))
    pipeline = Pipeline(default_modes("handset"), source.layout)
    episodes = draw_episodes(source, range(args.batch))
    kinds: dict[str, Callable[[], Iterator[int]]] = {
        "filterpy": lambda: filterpy_steps(pipeline, episodes[:8]),
        "env_on_filterpy": lambda: env_steps(backend="filterpy"),
        "single": env_steps,
        f"engine_{args.batch}": lambda: engine_steps(pipeline, episodes),
    }
    running = {}
    first_step_s = {}
    for name, make in kinds.items():
        begin = time.perf_counter()
        running[name] = make()
        next(running[name])
        first_step_s[name] = time.perf_counter() - begin
    for steps in running.values():  # past the end of an episode, so that all is compiled
        for _ in range(len(episodes[0])):
            next(steps)
    measured: dict[str, list[float]] = {name: [] for name in kinds}
    for _ in track(
        range(args.repeats), description="measuring", transient=True
    ):  # in turn, so that a drifting machine hits all alike
        for name, steps in running.items():
            measured[name].append(rate(steps, args.seconds))
    baseline = measured["filterpy"]
    ratios = {
        f"{name}_over_filterpy": [a / b for a, b in zip(values, baseline, strict=True)]
        for name, values in measured.items()
        if name != "filterpy"
    }
    print("ratio of steps per second                    median       min       max")
    for name, values in ratios.items():
        print(f"{name:38} {statistics.median(values):12.1f} {min(values):9.1f} {max(values):9.1f}")
    print("\nsteps per second (this machine, now)         median       min       max")
    for name, values in measured.items():
        print(f"{name:38} {statistics.median(values):12.0f} {min(values):9.0f} {max(values):9.0f}")
    print("\nfirst step, compilation included (s)")
    for name, seconds in first_step_s.items():
        print(f"{name:38} {seconds:12.2f}")
    if args.json:
        medians = {name: statistics.median(values) for name, values in ratios.items()}
        steps_per_s = {name: statistics.median(values) for name, values in measured.items()}
        write_json(
            args.json,
            {"ratios": medians, "steps_per_s": steps_per_s, "first_step_s": first_step_s},
        )


if __name__ == "__main__":
    run("benchmark")
