"""Environments of several places as one, for Stable-Baselines3."""

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from mmwave_env.sb3 import Indices, Infos


class PlacesVecEnv(VecEnv):
    """Vector environments beside each other, which are stepped together.

    Args:
        parts: with the same spaces.
        ahead: for each of them, how many epochs its first episodes are played before a reset
            returns, with action 0: episodes of different parts then end at different times, and
            every update of a network sees all phases of an episode.
    """

    def __init__(self, parts: Sequence[VecEnv], ahead: Sequence[int]) -> None:
        self._parts, self._ahead = tuple(parts), tuple(ahead)
        self._firsts = [0, *accumulate(part.num_envs for part in parts)]
        first = parts[0]
        super().__init__(self._firsts[-1], first.observation_space, first.action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed s for environment 0, s + 1 for the next, and so on through all the parts."""
        each = zip(self._parts, self._firsts, strict=False)
        if seed is None:
            return [one for part in self._parts for one in part.seed()]
        return [one for part, first in each for one in part.seed(seed + first)]

    def reset(self) -> NDArray[Any]:
        """Begin episodes everywhere; observations (n, features)."""
        observations = []
        for part, epochs in zip(self._parts, self._ahead, strict=True):
            seen = part.reset()
            for _ in range(epochs):
                seen, *_ = part.step(np.zeros(part.num_envs, np.int64))
            observations.append(cast(NDArray[Any], seen))  # boxes, as the spaces say
        self.reset_infos = [info for part in self._parts for info in part.reset_infos]
        return np.concatenate(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take actions (n,) for the step that :meth:`step_wait` makes."""
        for part, some in zip(self._parts, np.split(actions, self._firsts[1:-1]), strict=True):
            part.step_async(some)

    def step_wait(self) -> tuple[NDArray[Any], NDArray[np.float32], NDArray[np.bool_], Infos]:
        """Observations (n, features), rewards (n,), ends (n,) and infos of one step."""
        observations, rewards, over, infos = zip(
            *(part.step_wait() for part in self._parts), strict=True
        )
        together = [info for some in infos for info in some]
        return np.concatenate(observations), np.concatenate(rewards), np.concatenate(over), together

    def close(self) -> None:
        """Close all of them."""
        for part in self._parts:
            part.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of each environment, or of those of the indices."""
        return self._of([part.get_attr(attr_name) for part in self._parts], indices)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of all environments."""
        self._require_all(indices, f"set_attr({attr_name!r})")
        for part in self._parts:
            part.set_attr(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of all environments; what it returns for each."""
        self._require_all(indices, f"env_method({method_name!r})")
        told = [part.env_method(method_name, *method_args, **method_kwargs) for part in self._parts]
        return self._of(told)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Whether each of the indices is wrapped so."""
        return self._of([part.env_is_wrapped(wrapper_class) for part in self._parts], indices)

    def _of(self, told: Sequence[Sequence[Any]], indices: Indices = None) -> list[Any]:
        """What parts told of their environments, for those of the indices."""
        every = [one for some in told for one in some]
        return [every[i] for i in self._get_indices(indices)]

    def _require_all(self, indices: Indices, what: str) -> None:
        if indices is not None:
            raise ValueError(f"{what}: found indices {indices}, expected None, for all of them")
