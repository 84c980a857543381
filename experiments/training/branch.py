"""Train a switcher by rollout policy iteration with common random numbers.

In states along the way of the current policy every action is tried on the very same measurements,
each followed by the greedy policy for some epochs (:class:`BranchingEnv`); the network moves
towards what was better (:class:`RolloutLearner`), and so on. That is rollout policy iteration
(Bertsekas 2020), and exact but for the horizon: the world does not depend on actions.
"""

import time
from typing import Any

import numpy as np
import torch

from experiments.training.actor import folded, layer_tensors
from experiments.training.branching_env import BranchingEnv
from experiments.training.checkpoint import (
    going_on_from,
    read_stand,
    with_arrays,
    write_checkpoint,
)
from experiments.training.hyperparameters import BranchHyperparameters, falling
from experiments.training.job import Job, Tell
from experiments.training.looks import Looks
from experiments.training.progress_log import ProgressLog
from experiments.training.rollout_learner import RolloutLearner
from mmwave_env.files import write_json

LOOK = 8  # updates between two looks


class BranchTraining:
    """A training under way.

    Args:
        job: what to do; goes on where a checkpoint in its folder stands.
        tell: takes the number of states in which actions were tried and what is new.

    Raises:
        ValueError: the checkpoint is damaged.
    """

    def __init__(self, job: Job[BranchHyperparameters], tell: Tell) -> None:
        self._begun_s = time.monotonic()
        torch.set_num_threads(1)  # networks this small gain nothing from more
        torch.manual_seed(job.first_seed)
        self._job, self._tell = job, tell
        self._stand: dict[str, Any] = {
            "update": 0, "states": 0, "best": None, "beat_rule": None, "seconds": 0.0, "rows": [],
        }  # fmt: skip
        if job.checkpoint.exists():
            self._stand = read_stand(job.checkpoint, self._stand)
        recipe = job.recipe
        self._env = BranchingEnv(
            job.task, recipe.num_envs, recipe.horizon, recipe.gamma, job.first_seed
        )
        self._normal = self._env.measured_normalization(recipe.clip_observation)
        table = self._env.observation
        self._learner = RolloutLearner(len(table), len(table.actions), recipe, self._normal)
        self._looks = Looks(job, tell, self._stand)
        self._journal = ProgressLog(job.folder, self._stand["rows"])

    def run(self) -> dict[str, Any]:
        """Train to the end; figures of the training and of its best policy."""
        job, stand = self._job, self._stand
        if "learner" in stand:
            with going_on_from(job.checkpoint):
                self._restore()
        with self._journal:
            while stand["states"] < job.timesteps:
                figures = self._update()
                if stand["update"] % LOOK == 0 or stand["states"] >= job.timesteps:
                    figures |= self._look()
                self._journal.write(figures | {"seconds": self._seconds()}, {}, stand["states"])
                if stand["update"] % job.checkpoint_every == 0:
                    self._save()
                self._tell(stand["states"], "")
        outcome = {
            "seed": job.seed, "timesteps": stand["states"], "seconds": round(self._seconds(), 1),
            "beat_rule": stand["beat_rule"], "best": stand["best"],
        }  # fmt: skip
        write_json(job.outcome, outcome)
        job.checkpoint.unlink(missing_ok=True)
        return outcome

    def _update(self) -> dict[str, float]:
        """Try all actions in some states and learn from them; figures for the journal."""
        recipe, env, learner, stand = self._job.recipe, self._env, self._learner, self._stand
        new, taken = 0, np.zeros(len(env.observation.actions), np.int64)
        while new < recipe.states:
            tried = env.branch(learner.greedy)
            learner.remember(tried)
            new += len(tried.values)
            for _ in range(recipe.stride):
                actions = learner.sampled(env.observations)
                taken += np.bincount(actions, minlength=len(taken))
                env.step(actions)
        left = falling(recipe.final_fraction, 1.0 - stand["states"] / self._job.timesteps)
        stand["states"] += new
        stand["update"] += 1
        names = (f"share/{name}" for name in env.observation.actions)
        shares = dict(zip(names, (taken / taken.sum()).tolist(), strict=True))
        return shares | learner.improve(left)

    def _seconds(self) -> float:
        """Wall time of the training, of what came before an interruption too."""
        return float(self._stand["seconds"]) + time.monotonic() - self._begun_s

    def _look(self) -> dict[str, float]:
        actor = folded(layer_tensors(self._learner.network), self._normal)
        states = self._stand["states"]
        return self._looks.take(actor, self._env.observation, states, self._seconds())

    def _save(self) -> None:
        self._journal.save()
        write_checkpoint(
            self._job.checkpoint,
            self._stand | {
                "seconds": self._seconds(), "rows": self._journal.rows,
                "env": self._env.state(), "learner": self._learner.state(),
                "torch": torch.get_rng_state(),
            },
        )  # fmt: skip

    def _restore(self) -> None:
        stand = self._stand
        self._env.restore(with_arrays(stand.pop("env")))
        self._learner.restore(stand.pop("learner"))
        torch.set_rng_state(stand.pop("torch"))
