"""Timed workloads, their measurement in rounds, and the tables of ``mmwave-loc speed``.

An environment's step is computed in three ways: in a loop over filterpy's filters, in our single
environment, and in our vector environments. All three compute the predictions, gates, innovations
and posteriors of both modes and the reward of the chosen mode (always mode 1), and draw episodes
when needed. The filterpy loop leaves out observations, adaptive noise, recovery, and the metrics of
an episode. Filters are also timed alone.

The latency of a live track is the time to compute the user's position from the rows of an epoch.
"""

import gc
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from functools import partial
from itertools import count as numbers
from math import isnan
from statistics import median
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.console.output import grid, tracked
from experiments.evaluation.contenders import contender_from, draw_episodes
from experiments.timing.roofline import Operations, count, limit_s
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.datasets.log_folder import log_columns
from mmwave_env.engines.engine import Engine, tracker_of
from mmwave_env.engines.epoch import Asked, decide, filter_epoch, program_of, untuned
from mmwave_env.filters.bank import named_modes
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.filterpy_reference import filterpy_pipeline
from mmwave_env.filters.gating import Gate
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, measurement_of, process_noise
from mmwave_env.interface.policy import Switching
from mmwave_env.interface.reward import TrackingReward, terms_of, total
from mmwave_env.io.files import Json
from mmwave_env.localization.tracker import Tracker
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.task import task_from
from mmwave_env.world.episode import Episode, blank_incoming
from mmwave_env.world.travel import stride_of

ENVIRONMENT = "mmwave_env:MmWaveLoc-v0"
RADIO = "handset"
EPISODE = 200  # number of steps of an episode, as in the environment's default task
FILTERPY = "filterpy loop"
TRACKS = 1024  # number of tracks that a filter without an environment computes together
ALONE = ", 1 thread"  # end of the names of vector environments on one thread
THREADS = {"": 2, ALONE: 1}  # end of a name -> threads; two are the default on two cores
FILTERS = ("EKF", "UKF", "CKF")

Rounds = dict[str, list[float]]  # values by name, one per round
Laps = Iterator[int]  # yields, after each episode, its number of steps, summed over environments
Workloads = dict[str, Callable[[], Laps]]  # functions that start them, by name


def environments(sizes: Sequence[int]) -> Workloads:
    """Return functions that start the workloads of environments, by name."""
    return {
        FILTERPY: filterpy,
        "single environment": stepped,
        **{
            f"native, N = {n}{end}": partial(stepped, n, threads=threads)
            for end, threads in THREADS.items()
            for n in sizes
        },
    }


def filters() -> Workloads:
    """Return functions that start the workloads of single filters on one thread, by name."""
    episodes = draw_episodes(task_from().source, range(TRACKS))
    modes = named_modes(RADIO)
    return {name: partial(tracks, modes[name.lower()], episodes) for name in FILTERS}


def filterpy() -> Laps:
    """Run a Python loop over episodes with filterpy's filters."""
    task = task_from()
    twin = filterpy_pipeline(task.pipeline)
    for seed in numbers():
        filterpy_episode(twin, task.source.sample(np.random.default_rng(seed)))
        yield EPISODE


def filterpy_episode(twin: Pipeline, episode: Episode) -> float:
    """Filter an episode with all modes; return the total reward if the last mode is always used."""
    layout = twin.layout
    memory = initial_memory(layout, 1)
    reward = TrackingReward()
    site = unflatten(blank_site(layout), iter(episode.site().tolist()))
    blank = blank_incoming(layout)
    x = site.prior_x
    P = unpack(site.prior_P)
    paid = 0.0
    for row in episode.table().tolist():
        incoming = unflatten(blank, iter(row))
        epoch = incoming.epoch(layout)
        for mode in twin.modes:
            noise = process_noise(mode.tuning, epoch, site.hz_per_mps, 1.0, twin.planar)
            measurement = measurement_of(mode, memory, epoch, site, layout)
            prior = twin.predict(mode, x, P, noise, epoch.dt, site.hz_per_mps)
            posterior = twin.update(mode)(*prior, measurement, Gate(mode.gate))
        x = posterior.x
        P = posterior.P
        paid += total(terms_of(reward(Belief(x, P), incoming.truth)))
    return paid


def stepped(n: int = 0, **options: Any) -> Laps:
    """Step n environments (`gym.make_vec`) or, if n is 0, a single environment (`gym.make`).

    All episodes end at the same time.
    """
    make = partial(gym.make_vec, num_envs=n) if n else gym.make
    env = make(ENVIRONMENT, episode_steps=EPISODE, **options)
    env.reset(seed=0)
    actions = np.ones(n, np.int64) if n else np.int64(1)
    while True:
        for _ in range(EPISODE):
            over = env.step(actions)[3]
        assert np.all(over)
        if n:
            env.step(actions)  # this step only draws the next episodes
        else:
            env.reset()
        yield max(n, 1) * EPISODE


def tracks(mode: Mode, episodes: Sequence[Episode]) -> Laps:
    """Run a filter with its gates over complete episodes, again and again."""
    tracker = tracker_of(mode, episodes)
    while True:
        tracker.tune([mode.tuning])  # also puts the tracks back to their first epoch
        tracker.run()
        yield len(episodes) * EPISODE


# 4000 epochs; the first 1000 do not count
SCENE = "street"
EPOCHS = 4000
WARM_UP = 1000
PERCENTILES = (50.0, 99.0, 99.9)
EKF = "EKF"
LATENCIES = (EKF, "imm-best", "guided", "corrector")  # one mode, and contenders


def latency_us(name: str) -> list[float]:
    """Return percentiles of the latency of ``Tracker.update`` (microseconds)."""
    source = task_from(scene=SCENE, radio=RADIO, episode_steps=EPOCHS).source
    columns = log_columns(source.sample(np.random.default_rng(0)))
    cells = np.stack(list(columns.values()), axis=1).reshape(EPOCHS, -1, len(columns)).tolist()
    epochs = [
        [{n: v for n, v in zip(columns, row, strict=True) if not isnan(v)} for row in rows]
        for rows in cells
    ]
    ekf = Switching((named_modes(RADIO)["ekf"],))
    tracker = Tracker(SCENE, ekf if name == EKF else contender_from(name, RADIO), RADIO)
    times_s = [time.perf_counter()]
    for rows in epochs:
        tracker.update(rows)
        times_s.append(time.perf_counter())
    return np.percentile(1e6 * np.diff(times_s)[WARM_UP:], PERCENTILES).tolist()  # type: ignore[no-any-return]


# --- measurement

STEP = "step"  # name of the kernel (compiled function) that computes an environment's whole step


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
            ["one thread", "limit, ns per step", "time taken, ns", "limit reached, %"],
            [
                [
                    name,
                    spread(limits.get(name, limits[STEP]), 1e9),
                    spread(np.divide(1e9, rates[name]).tolist()),
                    spread(fractions, 100.0),
                ]
                for name, fractions in figures["limit_fraction"].items()
            ],
        ),
        "Latency": grid(
            ["one epoch", *(f"p{p:g}, microseconds" for p in PERCENTILES)],
            [
                [name, *(spread(figures["latency_us"][f"{name}, p{p:g}"]) for p in PERCENTILES)]
                for name in LATENCIES
            ],
        ),
    }
