"""Training of a policy with Stable-Baselines3's PPO, with evaluations and checkpoints."""

from inspect import signature
from typing import Any, cast

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from experiments.training.checkpoint import State, going_on_from
from experiments.training.hyperparameters import PpoHyperparameters, falling
from experiments.training.job import Job, News, Tell
from experiments.training.record import Record
from experiments.training.vec_env import PlacesVecEnv
from mmwave_env.interface.info import LAST_KEYS
from mmwave_env.io.files import Json
from policies.policy_file import Tensors
from policies.sb3 import model_tensors

# LOG: number of updates between two rows of the log. EARLY, LATER: number of updates between two
# evaluations, before and after a policy first beats the paper's rule.
LOG = 4
EARLY = 2
LATER = 16
MOMENTS = ("mean", "var", "count")  # attributes of RunningMeanStd, SB3's statistics of observations


class PpoTraining(BaseCallback):
    """A training in progress; Stable-Baselines3 calls it before, during and after each rollout.

    Args:
        job: training to run; if its folder has a checkpoint, the training continues from it.
        tell: function that is called with :class:`News` of the training.

    Attributes:
        env: environments of all places (scenes with a radio).
        normal: wrapper of ``env`` that normalizes its observations.

    Raises:
        ValueError: the checkpoint is damaged.
    """

    model: PPO

    def __init__(self, job: Job[PpoHyperparameters], tell: Tell) -> None:
        super().__init__()
        torch.set_num_threads(1)  # networks this small gain nothing from more threads
        self._job = job
        self._tell = tell
        self._record = Record(job, tell)
        self.env = PlacesVecEnv(job.task, job.hyperparameters)
        clip = job.hyperparameters.clip_observation
        self.normal = VecNormalize(self.env, norm_reward=False, clip_obs=clip)
        self.model = learner(self.normal, job.hyperparameters, self._record.first_seed)
        self._ended: list[Json] = []

    def run(self) -> Json:
        """Train to the end; return the outcome from :meth:`Record.close`."""
        job = self._job
        model = self.model
        progress = self._record.progress
        model.set_logger(Logger(None, [self._record.log]))
        if "learner" in progress:
            with going_on_from(job.checkpoint):
                self._restore(progress.pop("learner"))
        left = job.timesteps - model.num_timesteps
        fresh = not model.num_timesteps
        never: Any = None  # stops SB3's own logging; the annotation of log_interval forbids None
        model.learn(left, self, log_interval=never, reset_num_timesteps=fresh)
        progress["timesteps"] = model.num_timesteps
        self._evaluate()
        model.dump_logs()
        return self._record.close()

    @property
    def moments(self) -> RunningMeanStd:
        """Return mean and variance of the observations so far."""
        return cast(RunningMeanStd, self.normal.obs_rms)  # SB3's annotation allows a dict

    @property
    def actor(self) -> Tensors:
        """Return the actor's tensors in the form that a policy file stores."""
        return model_tensors(self.model)

    def _on_rollout_start(self) -> None:
        model = self.model
        job = self._job
        progress = self._record.progress
        progress["timesteps"] = model.num_timesteps
        hyper = job.hyperparameters
        left = 1.0 - model.num_timesteps / job.timesteps
        model.ent_coef = hyper.ent_coef * falling(hyper.final_fraction, left)
        update = model.num_timesteps // (hyper.num_envs * hyper.n_steps)
        if update == progress["update"]:
            return  # the training begins, or continues from a checkpoint
        progress["update"] = update
        if update % (LATER if progress["beat_rule"] else EARLY) == 0:
            self._evaluate()
        if update % LOG == 0:
            model.dump_logs()
        if update % job.checkpoint_every == 0:
            self._record.save(learner=self._learner_state())
        self._tell(News(model.num_timesteps))

    def _on_step(self) -> bool:
        self._ended += [info for info in self.locals["infos"] if "episode" in info]
        return True

    def _on_rollout_end(self) -> None:
        for key in (key for key in LAST_KEYS if self._ended and key in self._ended[0]):
            mean = float(np.mean([info[key] for info in self._ended]))
            self.logger.record_mean(f"rollout/{key}", mean)
        self._ended.clear()
        actions = self.model.rollout_buffer.actions.astype(np.int64).ravel()
        names = self.env.observation.actions
        for name, n in zip(names, np.bincount(actions, minlength=len(names)), strict=True):
            self.logger.record_mean(f"share/{name}", n / len(actions))
        self.logger.record("seconds", self._record.seconds)

    def _evaluate(self) -> None:
        for key, number in self._record.evaluate(self.actor, self.env.observation).items():
            self.logger.record(key, number)

    def _learner_state(self) -> State:
        """Return the weights, the optimizer and the normalization, for :meth:`_restore`."""
        moments = {name: torch.as_tensor(getattr(self.moments, name)) for name in MOMENTS}
        return {
            "timesteps": self.model.num_timesteps,
            "updates": self.model._n_updates,
            "parameters": self.model.get_parameters(),
            "moments": moments,
        }

    def _restore(self, state: State) -> None:
        """Go on from saved weights; the environments begin with new episodes."""
        self.model.num_timesteps = state["timesteps"]
        self.model._n_updates = state["updates"]
        self.model.set_parameters(state["parameters"], device="cpu")
        for name in MOMENTS:
            setattr(self.moments, name, state["moments"][name].numpy())


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
