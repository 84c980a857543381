"""Training of a policy with Stable-Baselines3's PPO."""

from inspect import signature
from typing import cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from experiments.training.hyperparameters import PpoHyperparameters, falling
from experiments.training.job import Job
from experiments.training.trainer import State, Trainer
from experiments.training.vec_env import PlacesVecEnv
from mmwave_env.interface.info import LAST_KEYS
from mmwave_env.io.files import Json
from policies.policy_file import Tensors
from policies.sb3 import model_tensors

MOMENTS = ("mean", "var", "count")  # attributes of RunningMeanStd, SB3's statistics of observations


class Ended(BaseCallback):
    """A collector of the last infos of episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.infos: list[Json] = []

    def _on_step(self) -> bool:
        self.infos += [info for info in self.locals["infos"] if "episode" in info]
        return True


class PpoTrainer(Trainer):
    """The updates of PPO.

    Args:
        job: training to run.
        seed: seed of all random numbers.

    Attributes:
        env: environments of all places (scenes with a radio).
        normal: wrapper of ``env`` that normalizes its observations.
        model: the algorithm and its network.
    """

    EARLY = 2
    LATER = 16

    def __init__(self, job: Job[PpoHyperparameters], seed: int) -> None:
        self._job = job
        self.judged = job.task
        self.env = PlacesVecEnv(job.task, job.hyperparameters)
        self.observation = self.env.observation.kind
        self.columns = self.env.observation.columns
        clip = job.hyperparameters.clip_observation
        self.normal = VecNormalize(self.env, norm_reward=False, clip_obs=clip)
        self.model = learner(self.normal, job.hyperparameters, seed)
        self.model.set_logger(Logger(None, []))
        self._ended = Ended()
        self._begin_episodes()

    def _begin_episodes(self) -> None:
        self.model._setup_learn(self._job.timesteps, self._ended)

    @property
    def moments(self) -> RunningMeanStd:
        """Return mean and variance of the observations so far."""
        return cast(RunningMeanStd, self.normal.obs_rms)  # SB3's annotation allows a dict

    def update(self, left: float) -> tuple[int, dict[str, float]]:
        """Collect steps and learn from them; return their number, and statistics."""
        model = self.model
        hyper = self._job.hyperparameters
        before = model.num_timesteps
        model.ent_coef = hyper.ent_coef * falling(hyper.final_fraction, left)
        self._ended.infos.clear()
        model.collect_rollouts(self.normal, self._ended, model.rollout_buffer, hyper.n_steps)
        model._update_current_progress_remaining(model.num_timesteps, self._job.timesteps)
        model.train()
        figures = {key: float(value) for key, value in model.logger.name_to_value.items()}
        model.logger.dump()  # forgets the values
        figures |= _means(self._ended.infos) | self._shares()
        return model.num_timesteps - before, figures

    def _shares(self) -> dict[str, float]:
        """Return the share of each action in the latest steps."""
        actions = self.model.rollout_buffer.actions.astype(np.int64).ravel()
        names = self.env.observation.actions
        counts = np.bincount(actions, minlength=len(names))
        return {f"share/{n}": float(k / len(actions)) for n, k in zip(names, counts, strict=True)}

    def tensors(self) -> Tensors:
        """Return the actor's tensors in the form that a policy file stores."""
        return model_tensors(self.model)

    def state(self) -> State:
        """Return the weights, the optimizer and the normalization."""
        return {
            "timesteps": self.model.num_timesteps,
            "parameters": self.model.get_parameters(),
            "moments": {k: torch.from_numpy(np.asarray(getattr(self.moments, k))) for k in MOMENTS},
        }

    def restore(self, state: State) -> None:
        """Go on from the weights of a :meth:`state`, with new episodes."""
        self.model.set_parameters(state["parameters"], device="cpu")
        for name in MOMENTS:
            setattr(self.moments, name, state["moments"][name].numpy())
        self._begin_episodes()
        self.model.num_timesteps = state["timesteps"]


def _means(infos: list[Json]) -> dict[str, float]:
    """Return the means of the metrics of episodes, given their last infos."""
    if not infos:
        return {}
    figures = {"rollout/reward": float(np.mean([info["episode"]["r"] for info in infos]))}
    for key in LAST_KEYS:
        if key in infos[0]:
            figures[f"rollout/{key}"] = float(np.mean([info[key] for info in infos]))
    return figures


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
