"""Vector environment for Stable-Baselines3, made of one native vector environment per place."""

from collections.abc import Sequence
from typing import Any, NoReturn, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from experiments.training.hyperparameters import PpoHyperparameters
from experiments.training.training_task import TrainingTask
from mmwave_env.interface.reward import PairedReward
from mmwave_env.numerics.numbers import Array32, Mask
from mmwave_env.sb3 import Indices, Infos, SB3VecEnv
from mmwave_env.vector_env import MmWaveLocVectorEnv
from mmwave_env.world.simulated import SimulatedSource


class PlacesVecEnv(VecEnv):
    """The environments of all places of a task, stepped together.

    A *place* is a scene with a radio and a rate of epochs. A reset also makes steps with
    action 0; their number differs by place. So episodes end at different times, and every update
    of a network has data from all phases of an episode.

    Args:
        task: task of the training.
        hyperparameters: number of environments, and whether to subtract an IMM's reward (paired).

    Attributes:
        envs: native vector environments, one per place.
        observation: table of features.

    """

    def __init__(self, task: TrainingTask, hyperparameters: PpoHyperparameters) -> None:
        count = hyperparameters.num_envs
        options: dict[str, Any] = {
            "observation": task.observation,
            "reward": PairedReward(task.reward) if hyperparameters.paired else task.reward,
            "autoreset_mode": "SameStep",
            "infos": "episode",
            "threads": 1,
        }
        # for each place, the numbers of its environments
        self._here = np.array_split(np.arange(count), len(task.places))
        self.envs = [
            MmWaveLocVectorEnv(len(here), **task.arguments(place), **options)
            for place, here in zip(task.places, self._here, strict=True)
        ]
        self.observation = self.envs[0].observation
        self._parts = [SB3VecEnv(env) for env in self.envs]
        first = self._parts[0]
        super().__init__(count, first.observation_space, first.action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Give environment i, counted across all places, the seed ``seed + i``."""
        seeds = super().seed(seed)
        for part, here in zip(self._parts, self._here, strict=True):
            part.seed(seeds[here[0]])
        return seeds

    def reset(self) -> NDArray[Any]:
        """Begin episodes in all environments; return observations (n, features)."""
        observations = []
        for k, (part, env) in enumerate(zip(self._parts, self.envs, strict=True)):
            table = part.reset()
            for _ in range(k * cast(SimulatedSource, env.source).epochs // len(self._parts)):
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

    def close(self) -> None:
        """Close all environments."""
        for part in self._parts:
            part.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of each environment, or only of those at ``indices``."""
        every = [value for part in self._parts for value in part.get_attr(attr_name)]
        return [every[i] for i in self._get_indices(indices)]

    def _unused(self, *_: Any, **__: Any) -> NoReturn:
        """Raise an error, since no training calls this method of a ``VecEnv``."""
        raise NotImplementedError

    set_attr = env_method = env_is_wrapped = _unused
