"""Training of a policy with Stable-Baselines3's PPO."""

from inspect import signature
from typing import Any, NoReturn, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from experiments.training.hyperparameters import PpoHyperparameters, falling
from experiments.training.trainer import Job, Trainer
from experiments.training.training_task import TrainingTask
from mmwave_env.interface.reward import PairedReward
from mmwave_env.numerics.numbers import Array32, Mask
from mmwave_env.sb3 import Indices, Infos, SB3VecEnv
from mmwave_env.vector_env import MmWaveLocVectorEnv
from policies.policy_file import Tensors
from policies.sb3 import model_tensors


class PlacesVecEnv(VecEnv):
    """The environments of all places of a task, stepped together.

    A *place* is a scene with a radio and a rate of epochs. A reset also makes steps with
    action 0; their number differs by place. So episodes end at different times, and every update
    of a network has data from all phases of an episode.

    Args:
        task: task of the training.
        hyperparameters: number of environments, and whether to subtract an IMM's reward (paired).

    Attributes:
        observation: table of features.

    """

    def __init__(self, task: TrainingTask, hyperparameters: PpoHyperparameters) -> None:
        count = hyperparameters.num_envs
        reward = PairedReward(task.reward) if hyperparameters.paired else task.reward
        # for each place, the numbers of its environments
        self._here = np.array_split(np.arange(count), len(task.places))
        self._parts = []
        for place, here in zip(task.places, self._here, strict=True):
            env = MmWaveLocVectorEnv(
                len(here),
                **task.arguments(place),
                observation=task.observation,
                reward=reward,
                autoreset_mode="SameStep",
                threads=1,
            )
            self._parts.append(SB3VecEnv(env))
        self.observation = env.observation
        first = self._parts[0]
        super().__init__(count, first.observation_space, first.action_space)

    def reset(self) -> NDArray[Any]:
        """Begin episodes in all environments; return observations (n, features).

        Environment i, counted across all places, has the seed of :meth:`seed` plus i.
        """
        observations = []
        for k, part in enumerate(self._parts):
            source, *_ = part.get_attr("source")
            part.seed(self._seeds[self._here[k][0]])
            table = part.reset()
            for _ in range(k * source.epochs // len(self._parts)):
                table, *_ = part.step(np.zeros(part.num_envs, np.int64))
            observations.append(cast(NDArray[Any], table))  # arrays, since the spaces are boxes
        return np.concatenate(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Set the actions (n,) of the step that :meth:`step_wait` makes."""
        for part, here in zip(self._parts, self._here, strict=True):
            part.step_async(actions[here])

    def step_wait(self) -> tuple[NDArray[Any], Array32, Mask, Infos]:
        """Return observations (n, features), rewards (n,), whether episodes ended (n,), infos."""
        *arrays, infos = zip(*(part.step_wait() for part in self._parts), strict=True)
        observations, rewards, over = map(np.concatenate, arrays)
        return observations, rewards, over, [info for part in infos for info in part]

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute, which is the same in all environments, once for each of them."""
        return self._parts[0].get_attr(attr_name, 0) * self.num_envs

    def _unused(self, *_: Any, **__: Any) -> NoReturn:
        """Raise an error, since no training calls this method of a ``VecEnv``."""
        raise NotImplementedError

    close = set_attr = env_method = env_is_wrapped = _unused


class PpoTrainer(Trainer):
    """The updates of PPO.

    Args:
        job: training to run.
        seed: seed of all random numbers.

    Attributes:
        model: the algorithm and its network.
    """

    EVERY = 16

    def __init__(self, job: Job, seed: int) -> None:
        self._job = job
        self.judged = job.task
        hyper: PpoHyperparameters = job.hyperparameters
        env = PlacesVecEnv(job.task, hyper)
        self.table = env.observation
        normal = VecNormalize(env, norm_reward=False, clip_obs=hyper.clip_observation)
        self.scales = vars(normal.obs_rms)
        self.model = learner(normal, hyper, seed)
        self.network = self.model.policy
        self.optimizers = (self.model.policy.optimizer,)

    def update(self, left: float) -> int:
        """Collect steps and learn from them; return their number."""
        model = self.model
        hyper: PpoHyperparameters = self._job.hyperparameters
        steps = hyper.num_envs * hyper.n_steps
        last = hyper.final_fraction
        rate = hyper.learning_rate * falling(last, left - steps / self._job.timesteps)
        model.lr_schedule = lambda _: rate
        model.ent_coef = hyper.ent_coef * falling(last, left)
        model.learn(steps, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
        return steps

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
        **options,
    )
    with torch.no_grad():
        cast(torch.nn.Linear, model.policy.action_net).bias[0] += hyper.first_action_bias
    return model
