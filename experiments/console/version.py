"""Versions, threads, cached kernels and a self-test: ``mmwave-loc --version --json``.

Kernels (compiled functions) are made on the machine that runs them, by the compiler that is
installed. The self-test compares their results with the same equations, computed in Python floats.
"""

import os
import platform

import numba
import numpy as np
from llvmlite.binding import get_host_cpu_name

from experiments.console.provenance import versions
from mmwave_env.compiler.disk_cache import kept_functions
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.engines.engine import Engine, play, run_imm
from mmwave_env.interface.policy import FixedMode
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.io.files import Json
from mmwave_env.numerics.numbers import Array
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.task import Task, task_from
from mmwave_env.world.episode import EpisodeBatch

TOLERANCE = 1e-6  # largest relative deviation that passes; correct kernels stay within 1e-9
_KEYS = np.arange(3, dtype=np.uint64)  # keys of episodes; fewer than the SIMD lanes of a block
_EPOCHS = 25


def about() -> Json:
    """Return the report as JSON; if kernels must be compiled, this takes about a minute."""
    return {
        "versions": versions(),
        "system": platform.platform(),
        "processor": numba.config.CPU_NAME or str(get_host_cpu_name()),
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "environments_at_a_time": WIDTH,
        "kernels": kept_functions(),
        "self_test": self_test(),
    }


def self_test() -> list[Json]:
    """Return each kernel's name, largest deviation from Python floats, and whether it passed."""
    shared = task_from(episode_steps=_EPOCHS, beliefs="shared")
    own = task_from(episode_steps=_EPOCHS, beliefs="per-mode")
    episodes = shared.simulated.sample_batch(_KEYS)
    on_floats = _stepped(own, episodes, on_floats=True)
    assert own.bank is not None
    imm = run_imm(own.bank, TrackingReward(), episodes, "x")["x"]
    shared_on_floats = _stepped(shared, episodes, on_floats=True)
    deviations = {
        "episodes": _episodes(shared, episodes),
        "one belief": _deviation(_stepped(shared, episodes, False), shared_on_floats),
        "a belief per mode": _deviation(_stepped(own, episodes, False), on_floats),
        "interacting multiple models": _deviation(imm.swapaxes(0, 1), on_floats),
    }
    return [
        {"kernel": name, "deviation": deviation, "passed": deviation <= TOLERANCE}
        for name, deviation in deviations.items()
    ]


def _deviation(computed: Array, expected: Array) -> float:
    """Return the largest difference, divided by max(1, largest magnitude in its column)."""
    size = np.maximum(np.abs(expected).max(axis=tuple(range(expected.ndim - 1))), 1.0)
    return float((np.abs(computed - expected) / size).max())


def _episodes(task: Task, episodes: EpisodeBatch) -> float:
    """Return how much epochs drawn by compiled code differ from epochs drawn in Python floats."""
    source = task.simulated
    starts = source.begin(_KEYS)
    world = source.world
    settings = source.feed(1).settings[:, 0]
    blank = np.zeros(world.ends[0])
    observed, happened, moved = world.parts
    computed = []
    for kept in starts.worlds:
        w = unflatten(world.template, iter(np.concatenate([blank, settings, kept]).tolist()))
        for _ in range(source.epochs):
            w = observed(w)
            for _ in range(int(w.settings.stride)):
                w = moved(happened(w))
            computed.append(flatten(w.measured))
    return _deviation(np.array(computed), episodes.table.reshape(len(computed), -1))


def _stepped(task: Task, episodes: EpisodeBatch, on_floats: bool) -> Array:
    """Return the estimates (epochs, n, 7) of episodes in which every action is 0."""
    engine = Engine(
        task.pipeline, len(_KEYS), TrackingReward(), bank=task.bank, on_floats=on_floats
    )
    engine.load(episodes)
    return play(engine, FixedMode(0), _EPOCHS, ("x",)).outputs["x"].swapaxes(0, 1)
