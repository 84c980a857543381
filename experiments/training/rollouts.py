"""Training of a switcher by rollout policy iteration with common random numbers.

In states that the current policy visits, every action is tried on the same measurements, each
followed by the greedy policy for some epochs (:class:`RolloutEnv`). The network moves towards the
better actions (:class:`RolloutLearner`), and so on. This is rollout policy iteration (Bertsekas
2020), and exact up to the horizon, since the world does not depend on actions.
"""

from typing import Any

import numpy as np
import torch

from experiments.training.actor import actor_tensors
from experiments.training.checkpoint import going_on_from, with_arrays
from experiments.training.hyperparameters import RolloutHyperparameters, falling
from experiments.training.job import Job, News, Tell
from experiments.training.record import Record
from experiments.training.rollout_env import RolloutEnv
from experiments.training.rollout_learner import RolloutLearner

EVALUATE = 8  # updates between two evaluations


class RolloutTraining:
    """A training in progress.

    Args:
        job: training to run; continues from a checkpoint in its folder, if any.
        tell: takes the news; a timestep is a state in which actions were tried.

    Attributes:
        env: environments in which actions are tried.
        learner: network that learns from the tried actions.

    Raises:
        ValueError: the checkpoint is damaged.
    """

    def __init__(self, job: Job[RolloutHyperparameters], tell: Tell) -> None:
        torch.set_num_threads(1)  # networks this small gain nothing from more threads
        torch.manual_seed(job.first_seed)
        self._job, self._tell = job, tell
        self._record = Record(job, tell)
        hyper = job.hyperparameters
        self.env = RolloutEnv(job.task, hyper.num_envs, hyper.horizon, hyper.gamma, job.first_seed)
        self._normal = self.env.measured_normalization(hyper.clip_observation)
        table = self.env.observation
        self.learner = RolloutLearner(len(table), len(table.actions), hyper, self._normal)

    def run(self) -> dict[str, Any]:
        """Train to the end; return figures of the training and of its best policy."""
        job, record, stand = self._job, self._record, self._record.stand
        if "learner" in stand:
            with going_on_from(job.checkpoint):
                self.env.restore(with_arrays(stand.pop("env")))
                self.learner.restore(stand.pop("learner"))
                torch.set_rng_state(stand.pop("torch"))
        with record.log as log:
            while stand["timesteps"] < job.timesteps:
                figures = self._update()
                if stand["update"] % EVALUATE == 0 or stand["timesteps"] >= job.timesteps:
                    actor = actor_tensors(self.learner.network, self._normal)
                    figures |= record.evaluate(actor, self.env.observation)
                log.write(figures | {"seconds": record.seconds}, {}, stand["timesteps"])
                if stand["update"] % job.checkpoint_every == 0:
                    record.save(
                        env=self.env.state(),
                        learner=self.learner.state(),
                        torch=torch.get_rng_state(),
                    )
                self._tell(News(stand["timesteps"]))
        return record.close()

    def _update(self) -> dict[str, float]:
        """Try all actions in some states and learn from them; return figures for the log."""
        hyper, env, learner = self._job.hyperparameters, self.env, self.learner
        new, taken = 0, np.zeros(len(env.observation.actions), np.int64)
        while new < hyper.states:
            tried = env.try_all(learner.greedy)
            learner.remember(tried)
            new += len(tried.values)
            for _ in range(hyper.stride):
                actions = learner.sampled(env.observations)
                taken += np.bincount(actions, minlength=len(taken))
                env.step(actions)
        stand = self._record.stand
        left = falling(hyper.final_fraction, 1.0 - stand["timesteps"] / self._job.timesteps)
        stand["timesteps"] += new
        stand["update"] += 1
        names = (f"share/{name}" for name in env.observation.actions)
        shares = dict(zip(names, (taken / taken.sum()).tolist(), strict=True))
        return shares | learner.improve(left)
