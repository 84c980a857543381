"""What PPO learns from, written in place: normalized observations, actions, rewards."""

from typing import Any, cast

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from experiments.training.tanh_network import Rows
from mmwave_env.numerics.arrays import Index, Mask


class Rollout(RolloutBuffer):
    """A buffer of Stable-Baselines3 that keeps its memory, and is written in place.

    Attributes:
        seen: (n_steps + 1, n, features): the observations, and those that come next.
        logits: (n_steps, actions, n) that the actions were drawn with.
    """

    def reset(self) -> None:
        """Begin anew."""
        if hasattr(self, "seen") and not self.generator_ready:
            self.pos, self.full = 0, False
            return
        super().reset()  # its own reader of batches has turned the arrays around
        steps, n = self.buffer_size, self.n_envs
        self.seen = np.zeros((steps + 1, n, *self.obs_shape), np.float32)
        self.observations = self.seen[:-1]
        self.logits = np.zeros((steps, cast(Any, self.action_space).n, n), np.float32)

    def time_major(self, indices: Index) -> Index:
        """Rows of the arrays as they are here for those of Stable-Baselines3's batches.

        Its buffer has the epochs of an environment side by side, this one the environments of an
        epoch.
        """
        env, step = np.divmod(indices, self.buffer_size)
        return step * self.n_envs + env


class RunningNormalization:
    """The observations of a ``VecNormalize`` normalized in place, in single precision.

    Args:
        normal: its statistics go on here.
        n: environments.
    """

    def __init__(self, normal: VecNormalize, n: int) -> None:
        self._normal = normal
        self._weights = np.full(n, 1.0 / n, np.float32)
        self._deviations = np.zeros(0, np.float32)

    def update(self, observations: Rows) -> None:
        """Let the statistics see observations (n, features)."""
        seen = cast(RunningMeanStd, self._normal.obs_rms)
        if self._deviations.shape != observations.shape:
            self._deviations = np.empty_like(observations)
        origin = seen.mean.astype(np.float32)  # near the mean, so that squares lose nothing
        deviations = np.subtract(observations, origin, out=self._deviations)
        first = (self._weights @ deviations).astype(np.float64)
        np.multiply(deviations, deviations, out=deviations)
        second = (self._weights @ deviations).astype(np.float64)
        seen.update_from_moments(origin + first, second - first * first, len(observations))

    def write(self, observations: Rows, out: Rows) -> None:
        """Normalize observations (k, features) into ``out``, of the same shape."""
        normal, seen = self._normal, cast(RunningMeanStd, self._normal.obs_rms)
        scale = (1.0 / np.sqrt(seen.var + normal.epsilon)).astype(np.float32)
        np.subtract(observations, seen.mean.astype(np.float32), out=out)
        out *= scale
        np.clip(out, -normal.clip_obs, normal.clip_obs, out=out)


def stack(before: Rows, now: Rows, over: Mask, out: Rows) -> None:
    """The latest frames (n, frames * features), after those before.

    Args:
        before: (n, frames * features).
        now: (n, features).
        over: (n,) where an episode ended; what came before is nothing there.
        out: (n, frames * features).
    """
    features = now.shape[1]
    out[:, :-features] = before[:, features:]
    out[over] = 0.0
    out[:, -features:] = now
