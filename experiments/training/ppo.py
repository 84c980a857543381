"""Training of a policy with Stable-Baselines3's PPO."""

from inspect import signature
from typing import cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

from experiments.training.hyperparameters import PpoHyperparameters, falling
from experiments.training.job import Job
from experiments.training.trainer import Trainer
from experiments.training.vec_env import PlacesVecEnv
from policies.policy_file import Tensors
from policies.sb3 import model_tensors


class PpoTrainer(Trainer):
    """The updates of PPO.

    Args:
        job: training to run.
        seed: seed of all random numbers.

    Attributes:
        normal: environments of all places (scenes with a radio), with normalized observations.
        model: the algorithm and its network.
    """

    EVERY = 16

    def __init__(self, job: Job, seed: int) -> None:
        self._job = job
        self.judged = job.task
        hyper: PpoHyperparameters = job.hyperparameters
        env = PlacesVecEnv(job.task, hyper)
        self.table = env.observation
        self.normal = VecNormalize(env, norm_reward=False, clip_obs=hyper.clip_observation)
        self.scales = vars(self.normal.obs_rms)
        self.model = learner(self.normal, hyper, seed)
        self.model.set_logger(Logger(None, []))
        self.network = self.model.policy
        self.optimizer = self.model.policy.optimizer

    def update(self, left: float) -> tuple[int, dict[str, float]]:
        """Collect steps and learn from them; return their number, and statistics."""
        model = self.model
        hyper: PpoHyperparameters = self._job.hyperparameters
        if model._last_obs is None:
            _, self._callback = model._setup_learn(self._job.timesteps, None)
        steps = hyper.num_envs * hyper.n_steps
        model.ent_coef = hyper.ent_coef * falling(hyper.final_fraction, left)
        model.collect_rollouts(self.normal, self._callback, model.rollout_buffer, hyper.n_steps)
        model._current_progress_remaining = left - steps / self._job.timesteps
        model.train()
        figures = {key: float(value) for key, value in model.logger.name_to_value.items()}
        model.logger.dump()  # forgets the values
        ended = [episode["r"] for episode in model.ep_info_buffer or ()]  # the latest 100 episodes
        return steps, figures | ({"rollout/reward": float(np.mean(ended))} if ended else {})

    def tensors(self) -> Tensors:
        """Return the actor's tensors in the form that a policy file stores."""
        return model_tensors(self.model)


def learner(venv: VecNormalize, hyper: PpoHyperparameters, seed: int) -> PPO:
    """Return the PPO algorithm, ready to learn; also seed the environments.

    Args:
        venv, hyper: environments to learn in, and hyperparameters.
        seed: seed of all random numbers.
    """
    layers = list(hyper.hidden)
    accepted = signature(PPO).parameters
    options = {name: value for name, value in vars(hyper).items() if name in accepted}
    rate = hyper.learning_rate
    last = hyper.final_fraction
    model = PPO(
        "MlpPolicy",
        venv,
        policy_kwargs={
            "net_arch": {"pi": layers, "vf": layers},
            "activation_fn": torch.nn.Tanh,
            "optimizer_kwargs": {"eps": 1e-5, "fused": True},  # eps is SB3's default
        },
        seed=seed,
        device="cpu",
        **options | {"learning_rate": lambda left: rate * falling(last, left)},
    )
    with torch.no_grad():
        cast(torch.nn.Linear, model.policy.action_net).bias[0] += hyper.first_action_bias
    return model
