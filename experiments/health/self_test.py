"""Every kernel beside independent twins, in seconds: floats, filterpy's filters, numpy.

Kernels are compiled on the machine that runs them, by its own version of the compiler; this tells
whether what came out computes what the sources say.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.engines.smoothing import smooth
from mmwave_env.engines.track_engine import Tracker
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.numerics.random import next_word, seeded, word_of
from mmwave_env.reward import TrackingReward
from mmwave_env.task import Task, task_from
from mmwave_env.world.episode import Episode, EpisodeBatch

TOLERANCE = 1e-6  # standard deviations, or of the largest number; sound kernels are within 1e-9
_KEYS = np.arange(3, dtype=np.uint64)  # three episodes: a block of lanes that is not full
_EPOCHS = 25
_NAME = "mmwave_env:MmWaveLoc-v0"
_MANY = 360  # environments: 45 blocks; more epochs of blocks than plain Python runs
_ENDS = ("ate_m", "rpe_m", "smoothed_ate_m")
_TRIANGLE = np.tril_indices(7)


class Check(NamedTuple):
    """A kernel beside its twin."""

    kernel: str
    twin: str
    deviation: float  # the largest, relative; NaN where either is not finite

    @property
    def passed(self) -> bool:
        """Whether both are the same but for rounding."""
        return self.deviation <= TOLERANCE


def self_test(with_filterpy: bool) -> Iterator[Check]:
    """Check after check.

    Args:
        with_filterpy: whether filterpy is there to be held beside.
    """
    task = task_from(episode_steps=_EPOCHS)
    drawn = task.simulated.episodes(_KEYS)
    episodes = EpisodeBatch.of(drawn)
    tests: list[tuple[str, str, Callable[[], float]]] = [
        ("random numbers", "numpy's SFC64", _random),
        ("episodes as they go", "floats", lambda: _world(task, episodes)),
        ("environment, one belief", "floats", lambda: _environment(task, episodes)),
        ("environment, a belief per mode", "floats", lambda: _environment(
            task_from(episode_steps=_EPOCHS, beliefs="per-mode"), episodes)),
        ("interacting multiple models", "the environment on floats", lambda: _imm(episodes)),
        ("smoother", "numpy", lambda: _smoother(task, drawn)),
        ("vector environment, to its ends", "single environments", _vector),
    ]  # fmt: skip
    if with_filterpy:
        tests.insert(-3, ("tracks of EKF, UKF and CKF", "filterpy", lambda: _tracks(drawn)))
    for kernel, twin, test in tests:
        yield Check(kernel, twin, test())


def _deviation(found: Array, expected: Array) -> float:
    """The largest difference, relative to the numbers' size in the same column."""
    size = np.maximum(np.abs(expected).max(axis=tuple(range(expected.ndim - 1))), 1.0)
    return float((np.abs(found - expected) / size).max())


def _random() -> float:
    generator = np.random.SFC64(0)
    state = generator.state
    wrong = 0
    for key in (0, 1, 2**63 + 5):
        number = float(np.uint64(key).view(np.float64))
        words = [word_of(each) for each in seeded(number, 0)]
        state["state"]["state"] = np.array([key, key, 0, 1], np.uint64)
        generator.state = state
        generator.random_raw(18)  # the key is mixed before the first number
        for _ in range(8):
            word, words = next_word(words)
            wrong += int(word.value != generator.random_raw())
    return float(wrong)


def _world(task: Task, episodes: EpisodeBatch) -> float:
    """Epochs drawn by compiled code beside those of the same equations on floats."""
    source = task.simulated
    begun, world = source.begin(_KEYS), source.world
    settings = source.feed(begun.worlds).settings[:, 0]
    blank = np.zeros(world.ends[0])
    found = []
    for kept in begun.worlds:
        w = unflatten(world.template, iter(np.concatenate([blank, settings, kept]).tolist()))
        for dt in source.steps_s:
            w = world.epoch(w)
            found.append(flatten(w.measured._replace(dt=dt)))
    return _deviation(np.array(found), episodes.table.reshape(len(found), -1))


def _stepped(task: Task, episodes: EpisodeBatch, on_floats: bool) -> Array:
    """Observations, beliefs and rewards (epochs, n, numbers) of changing actions."""
    engine = Engine(task.pipeline, len(_KEYS), TrackingReward(), bank=task.bank,
                    on_floats=on_floats)  # fmt: skip
    engine.reset(episodes)
    actions = len(task.pipeline.modes) + (task.bank is not None)
    rows = []
    for epoch in range(_EPOCHS):
        engine.step((np.arange(len(_KEYS)) + epoch) % actions)
        read = [
            engine.read(part) for part in (engine.at.x, engine.at.reward, engine.at.observation)
        ]
        rows.append(np.column_stack(read))
    return np.array(rows)


def _environment(task: Task, episodes: EpisodeBatch) -> float:
    return _deviation(*(_stepped(task, episodes, on_floats) for on_floats in (False, True)))


def _vector() -> float:
    """Rewards and metrics of so many that all loops around the kernels are compiled."""
    few, actions = len(_KEYS), 1
    options: dict[str, Any] = {"episode_steps": _EPOCHS, "smoothed": True}
    envs = gym.make_vec(_NAME, num_envs=_MANY, **options)
    envs.reset(seed=0)
    for _ in range(_EPOCHS):
        _, rewards, _, _, infos = envs.step(np.full(_MANY, actions))
    found = [rewards[:few], *(infos[name][:few] for name in _ENDS)]
    expected = []
    for seed in range(few):
        env = gym.make(_NAME, **options)
        env.reset(seed=seed)
        for _ in range(_EPOCHS):
            _, reward, _, _, info = env.step(np.int64(actions))
        expected.append([float(reward), *(info[name] for name in _ENDS)])
    return _deviation(np.array(found).T, np.array(expected))


def _imm(episodes: EpisodeBatch) -> float:
    """Whole tracks in one call, beside the environment that nobody acts in."""
    task = task_from(episode_steps=_EPOCHS, beliefs="per-mode")
    assert task.bank is not None
    engine = Engine(task.pipeline, len(_KEYS), TrackingReward(), bank=task.bank, on_floats=True)
    engine.reset(episodes)
    expected = []
    for _ in range(_EPOCHS):
        engine.step(np.zeros(len(_KEYS), np.int64))
        expected.append(engine.read(engine.at.x))
    bank = task.bank
    imm = ImmEngine(task.pipeline, TrackingReward(), bank.transition, bank.nis_quantile)
    found = imm.run(episodes, "x")["x"]
    return _deviation(found.swapaxes(0, 1), np.array(expected))


def _tracks(episodes: Sequence[Episode]) -> float:
    """Tracks on lanes beside those of filterpy's filters on floats, in standard deviations."""
    from mmwave_env.filters.filterpy_reference import filterpy_pipeline

    modes = task_from(modes=["ekf", "ukf", "ckf"]).pipeline
    worst = []
    for mode in modes.modes:
        alone = replace(modes, modes=(mode,))
        found, expected = (
            _tracked(pipeline, episodes, on_floats)
            for pipeline, on_floats in ((alone, False), (filterpy_pipeline(alone), True))
        )
        sigma = np.sqrt(_unpacked(expected["P"])[..., range(7), range(7)])
        worst.append(float((np.abs(found["x"] - expected["x"]) / sigma).max()))
    return max(worst)


def _tracked(
    pipeline: Pipeline, episodes: Sequence[Episode], on_floats: bool = False
) -> dict[str, Array]:
    tracker = Tracker(pipeline, len(_KEYS), on_floats=on_floats)
    tracker.load(episodes)
    return tracker.run("x", "P", "x_predicted", "P_predicted")


def _unpacked(P: Array) -> Array:
    """Symmetric matrices (..., 7, 7) from packed triangles (..., 28)."""
    full = np.zeros((*P.shape[:-1], 7, 7))
    full[..., _TRIANGLE[0], _TRIANGLE[1]] = full[..., _TRIANGLE[1], _TRIANGLE[0]] = P
    return full


def _smoother(task: Task, episodes: Sequence[Episode]) -> float:
    """Rauch-Tung-Striebel as the textbook has it, with matrices (Saerkkae 2013, algorithm 8.2)."""
    pipeline = replace(task.pipeline, modes=task.pipeline.modes[:1])
    track = _tracked(pipeline, episodes)
    given = [track[name] for name in ("x", "P", "x_predicted", "P_predicted")]
    found, _ = smooth(given[0], given[1], given[2], given[3], np.ones(_EPOCHS - 1))
    F = np.eye(7) + np.diag([1.0, 1.0, 1.0, 0.0], k=3)
    worst = []
    for x, P, x_predicted, P_predicted, ours in zip(*given, found, strict=True):
        full, coming, smoothed = _unpacked(P), _unpacked(P_predicted), x.copy()
        for t in reversed(range(_EPOCHS - 1)):
            gain = full[t] @ F.T @ np.linalg.inv(coming[t + 1])
            smoothed[t] += gain @ (smoothed[t + 1] - x_predicted[t + 1])
        sigma = np.sqrt(full[:, range(7), range(7)])
        worst.append(float((np.abs(ours - smoothed) / sigma).max()))
    return max(worst)
