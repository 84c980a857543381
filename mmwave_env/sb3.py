"""Vector environments for Stable-Baselines3; needs the ``train`` extra.

from mmwave_env.sb3 import SB3VecEnv

env = gymnasium.make_vec("MmWaveLoc-v0", num_envs=256, autoreset_mode="SameStep")
model = PPO("MlpPolicy", SB3VecEnv(env))
"""

import time
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mmwave_env.io.lookup import require_extra

require_extra("stable_baselines3", "train", "mmwave_env.sb3")
from stable_baselines3.common.monitor import Monitor  # noqa: E402
from stable_baselines3.common.vec_env import VecEnv  # noqa: E402

Indices = None | int | Iterable[int]
Info = dict[str, Any]
Infos = list[Info]


class SB3VecEnv(VecEnv):
    """A Gymnasium vector environment as a ``VecEnv`` of Stable-Baselines3.

    The info of an episode's last step contains the metrics of the episode and the keys that
    Stable-Baselines3 reads: ``terminal_observation``, the last observation;
    ``TimeLimit.truncated``, True if the episode was truncated (learners then assume that rewards
    would follow); ``episode`` with the return "r", the length "l", and "t", the seconds
    since this object was created. All other infos are empty.

    Raises:
        ValueError: the autoreset mode is not "SameStep"; other modes begin the next episode one
            step later, or only when ``reset`` is called.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any]) -> None:
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                f'autoreset_mode: found {getattr(mode, "value", mode)!r}, expected "SameStep": '
                'gymnasium.make_vec(..., autoreset_mode="SameStep")'
            )
        self.env = env
        self._actions: NDArray[Any] = np.zeros(0, np.int64)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, np.int64)
        self._begun_s = time.time()
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Any:
        """Begin all episodes with the seeds and options set earlier; return observations (n, ...).

        All environments are reset together, so their options must be the same.
        """
        if any(options != self._options[0] for options in self._options):
            raise ValueError(
                f"options: found {self._options}, expected the same for all environments"
            )
        seeds: Any = list(self._seeds)  # Gymnasium's annotation omits lists
        observations, _ = self.env.reset(seed=seeds, options=self._options[0] or None)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store actions (n, ...) for the step that :meth:`step_wait` makes."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], Infos]:
        """Make a step; return observations (n, ...), rewards (n,), ends (n,) and infos."""
        observations, rewards, terminated, truncated, batched = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        over = terminated | truncated
        infos: Infos = [{} for _ in range(self.num_envs)]
        for i in map(int, np.flatnonzero(over)):
            infos[i] = _of(batched["final_info"], i) | {
                "terminal_observation": batched["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {
                    "r": float(self._returns[i]),
                    "l": int(self._lengths[i]),
                    "t": round(time.time() - self._begun_s, 6),
                },
            }
        self._returns[over] = 0.0
        self._lengths[over] = 0
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return a list that contains an attribute of the environment once for each index."""
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the vector environment; ``indices`` must be None or all indices."""
        self._require_all(indices, f"set_attr({attr_name!r})")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the vector environment once; return the result once for each index."""
        self._require_all(indices, f"env_method({method_name!r})")
        method: Callable[..., Any] = getattr(self.env, method_name)
        return [method(*method_args, **method_kwargs)] * self.num_envs

    def get_images(self) -> list[Any]:
        """Return the pictures (height, width, 3) of the environments, as ``render`` shows them."""
        return list(self.env.render() or ())

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Return, for each index, True if the wrapper is Monitor, whose work this class does."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def _require_all(self, indices: Indices, call: str) -> None:
        if len(set(self._get_indices(indices))) < self.num_envs:
            raise ValueError(f"{call}: found indices {indices}, expected all indices")


def _of(batched: Info, i: int) -> Info:
    """Return environment i's info from batched infos; skip a key if its mask is False at i."""
    info: Info = {}
    for key, value in batched.items():
        mask = batched.get(f"_{key}")
        if not (key[:1] == "_" and key[1:] in batched) and (mask is None or mask[i]):
            info[key] = _of(value, i) if isinstance(value, dict) else value[i]
    return info
