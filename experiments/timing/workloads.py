"""Timed workloads: steps of environments, and filters alone.

An environment's step is computed in three ways: in a loop over filterpy's filters, in our single
environment, and in our vector environments. All three compute the predictions, gates, innovations
and posteriors of both modes and the reward of the chosen mode (always mode 1), and draw episodes
when needed. The filterpy loop leaves out observations, adaptive noise, recovery, and the metrics of
an episode.

The latency of a live track is the time to compute the user's position from the rows of an epoch.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from math import isnan
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.evaluation.contenders import contender_from, draw_episodes
from mmwave_env.datasets.log_folder import log_columns
from mmwave_env.engines.engine import tracker_of
from mmwave_env.filters.bank import named_modes
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.filterpy_reference import filterpy_pipeline
from mmwave_env.filters.gating import Gate
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, measurement_of, process_noise
from mmwave_env.interface.policy import Switching
from mmwave_env.interface.reward import TrackingReward, terms_of, total
from mmwave_env.localization.tracker import Tracker
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.task import task_from
from mmwave_env.world.episode import Episode, blank_incoming

ENVIRONMENT = "mmwave_env:MmWaveLoc-v0"
RADIO = "handset"
EPISODE = 200  # number of steps of an episode, as in the environment's default task
FILTERPY = "filterpy loop"
TRACKS = 1024  # number of tracks that a filter without an environment computes together
BOTH = 2  # number of threads that `gymnasium.make_vec` uses by default on two cores
THREADS = (BOTH, 1)
ALONE = ", 1 thread"  # end of the names of environments on one thread
FILTERS = ("EKF", "UKF", "CKF")

Laps = Iterator[int]  # yields, after each episode, its number of steps, summed over environments


def native_name(n: int, threads: int = BOTH) -> str:
    """Return the name, in results, of our vector environment with n environments."""
    return f"native, N = {n}" + ("" if threads == BOTH else ALONE)


def environments(sizes: Sequence[int]) -> dict[str, Callable[[], Laps]]:
    """Return functions that start the workloads of environments, by name."""
    return {
        FILTERPY: filterpy,
        "single environment": stepped,
        **{
            native_name(n, threads): partial(stepped, n, threads=threads)
            for threads in THREADS
            for n in sizes
        },
    }


def filters() -> dict[str, Callable[[], Laps]]:
    """Return functions that start the workloads of single filters on one thread, by name."""
    episodes = draw_episodes(task_from().source, range(TRACKS))
    modes = named_modes(RADIO)
    return {name: partial(tracks, modes[name.lower()], episodes) for name in FILTERS}


def filterpy() -> Laps:
    """Run a Python loop over episodes with filterpy's filters."""
    task = task_from()
    twin = filterpy_pipeline(task.pipeline)
    for seed in count():
        filterpy_episode(twin, task.source.sample(np.random.default_rng(seed)))
        yield EPISODE


def filterpy_episode(twin: Pipeline, episode: Episode) -> float:
    """Filter an episode with all modes; return the total reward if the last mode is always used."""
    layout = twin.layout
    memory = initial_memory(twin.layout, 1)
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
