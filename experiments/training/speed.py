"""How fast PPO trains, and where the time goes: our loop and Stable-Baselines3's, in turns."""

import time
from collections.abc import Iterator
from math import lcm
from typing import Any

import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from experiments.training.fast_ppo import FastPPO
from experiments.training.hyperparameters import (
    Hyperparameters,
    read_hyperparameters,
    shipped_hyperparameters,
)
from experiments.training.network import learner
from experiments.training.places import Place
from experiments.training.training_env import TrainingEnv
from experiments.training.training_task import TrainingTask, banks_of
from mmwave_env.reward import TrackingReward

PARTS = ("environment", "normalization", "actor and critic", "update", "other")
ENVIRONMENT, NORMALIZATION, NETWORKS, UPDATE, OTHER = PARTS
LOOPS = {"ours": True, "Stable-Baselines3's own": False}  # whether it is the fast one
EPISODE = 200  # epochs of an episode
Rounds = dict[str, list[float]]


class Stopwatch:
    """Seconds spent in each part; a part that calls another does not count the other's.

    Attributes:
        seconds: by part, until :meth:`stop`.
    """

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Begin anew, in :data:`OTHER`."""
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self._part, self._since = OTHER, time.perf_counter()

    def stop(self) -> None:
        """Count what is left."""
        self._turn(OTHER)

    def _turn(self, part: str) -> str:
        """Count for another part from now on; the part until now."""
        now = time.perf_counter()
        before = self._part
        self.seconds[before] += now - self._since
        self._part, self._since = part, now
        return before

    def watch(self, owner: Any, method: str, part: str) -> None:
        """Count the calls of an object's method for a part."""
        inner = getattr(owner, method)

        def watched(*args: Any, **kwargs: Any) -> Any:
            before = self._turn(part)
            try:
                return inner(*args, **kwargs)
            finally:
                self._turn(before)

        setattr(owner, method, watched)


class TrainingSpeed:
    """Rates and parts of the two loops; every list has an entry a round.

    Attributes:
        steps_per_s: by loop.
        us: microseconds of a step, by loop and part.
    """

    def __init__(self) -> None:
        self.steps_per_s: Rounds = {loop: [] for loop in LOOPS}
        self.us: dict[str, Rounds] = {loop: {part: [] for part in PARTS} for loop in LOOPS}

    def run(self, seconds: float, repeats: int) -> Iterator[float]:
        """Measure, and tell the share done after every piece.

        In every round each loop has its turn, of whole episodes, for at least that many seconds. A
        turn of each before does not count: it compiles.
        """
        torch.set_num_threads(1)
        pieces, done = len(LOOPS) * (repeats + 1), 0
        begun = {loop: _begun(fast) for loop, fast in LOOPS.items()}
        for counts in [False] + [True] * repeats:
            for loop, (model, watch) in begun.items():
                steps = _turn(model, watch, seconds)
                if counts:
                    self.steps_per_s[loop].append(steps / sum(watch.seconds.values()))
                    for part, spent in watch.seconds.items():
                        self.us[loop][part].append(1e6 * spent / steps)
                done += 1
                yield done / pieces

    def json(self) -> dict[str, Any]:
        """Every round of every figure."""
        ours, theirs = self.steps_per_s.values()
        ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
        return {"ratios": ratios, "steps_per_s": self.steps_per_s, "us_per_step": self.us}


def _begun(fast: bool) -> tuple[OnPolicyAlgorithm, Stopwatch]:
    """A training by the shipped recipe, under a stopwatch."""
    recipe = read_hyperparameters(shipped_hyperparameters("ppo"), "ppo")
    assert isinstance(recipe, Hyperparameters)
    places = (Place("street", "handset"),)
    task = TrainingTask("mixed", places, banks_of((), places, "shared"), "full", TrackingReward())
    world = TrainingEnv(task, recipe)
    model, watch = learner(world, recipe, 0, fast), Stopwatch()
    model.set_logger(Logger(None, []))
    for env in world.envs:
        watch.watch(env, "step", ENVIRONMENT)
    watch.watch(model, "train", UPDATE)
    if isinstance(model, FastPPO):
        networks, normalization = ("draw", "judge"), model.normalization
        for method in networks:
            watch.watch(model, method, NETWORKS)
        for method in ("update", "write"):
            watch.watch(normalization, method, NORMALIZATION)
        return model, watch
    for method in ("forward", "predict_values"):
        watch.watch(model.policy, method, NETWORKS)
    watch.watch(world.normal, "step_wait", NORMALIZATION)
    for adapter in world.adapters:
        watch.watch(adapter, "step_wait", OTHER)
    return model, watch


def _turn(model: OnPolicyAlgorithm, watch: Stopwatch, seconds: float) -> int:
    """Train for at least that many seconds, until episodes end; how many steps that were."""
    begun = model.num_timesteps
    epochs = lcm(model.n_steps, EPISODE)  # then an episode ends with an update
    watch.start()
    while True:
        # Its own type knows no None for the interval, its code does.
        model.learn(
            epochs * model.n_envs, log_interval=None,  # type: ignore[arg-type]
            reset_num_timesteps=not model.num_timesteps,
        )  # fmt: skip
        watch.stop()
        if sum(watch.seconds.values()) >= seconds:
            return model.num_timesteps - begun
