"""What a switcher is trained in: the native vector environment, and wrappers around it."""

from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from experiments.training.hyperparameters import Hyperparameters
from experiments.training.places import require_environments, shares
from experiments.training.places_env import PlacesVecEnv
from experiments.training.training_task import TrainingTask
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.reward import PairedReward
from mmwave_env.sb3 import Infos, SB3VecEnv
from mmwave_env.vector_env import MmWaveLocVectorEnv

Array = NDArray[Any]

TRUTH = 7  # numbers of the truth that a critic sees


class PrivilegedObservation(VecEnvWrapper):
    """Observations followed by how wrong the belief is, for a critic in training.

    Position error (m) and velocity error (m/s) along, to the left of and above the true
    velocity, and the true speed (m/s).
    """

    def __init__(self, venv: VecEnv, env: MmWaveLocVectorEnv) -> None:
        space = cast(gym.spaces.Box, venv.observation_space)  # of SB3VecEnv
        shape = (space.shape[0] + TRUTH,)
        super().__init__(venv, gym.spaces.Box(-np.inf, np.inf, shape, np.float32))
        self._batch = env.batch

    def reset(self) -> Array:
        """Observations of the first epochs."""
        return self._extended(_one_array(self.venv.reset()))

    def step_wait(self) -> tuple[Array, Array, NDArray[np.bool_], Infos]:
        """As the environment's, but for the observations."""
        observations, rewards, over, infos = self.venv.step_wait()
        for i in np.flatnonzero(over):
            end = infos[i]
            truth = how_wrong(end["estimate"][None], end["truth"][None])[0]
            end["terminal_observation"] = np.append(end["terminal_observation"], truth)
        return self._extended(_one_array(observations)), rewards, over, infos

    def _extended(self, observations: Array) -> Array:
        at, read = self._batch.at, self._batch.read
        return np.concatenate([observations, how_wrong(read(at.x), read(at.truth))], axis=1)


def _one_array(observations: object) -> Array:
    """Observations as they are: those of SB3VecEnv are no dict or tuple, which VecEnv allows."""
    return cast(Array, observations)


def how_wrong(estimate: Array, truth: Array) -> NDArray[np.float32]:
    """What `PrivilegedObservation` adds (n, 7).

    Args:
        estimate: (n, 7) states.
        truth: (n, 6) true positions and velocities.
    """
    error = estimate[:, :6] - truth
    vx, vy = truth[:, 3], truth[:, 4]
    speed = np.hypot(vx, vy)
    ahead = np.stack([vx, vy]) / np.maximum(speed, 1e-9)
    still = speed < 1e-9
    ahead[:, still] = [[1.0], [0.0]]
    columns = []
    for x, y, z in (error[:, :3].T, error[:, 3:].T):
        columns += [x * ahead[0] + y * ahead[1], y * ahead[0] - x * ahead[1], z]
    return np.stack([*columns, speed], axis=1).astype(np.float32)


class TrainingEnv:
    """A task with the wrappers of a recipe, and how to stop and go on.

    Args:
        task: what is learned.
        recipe: how.

    Attributes:
        envs: the native environments, of a place each.
        observation: their table of features.
        features: of an observation, without the truth.
        truth: numbers of the truth that follow them for the critic.
        adapters: each place for Stable-Baselines3.
        normal: normalizes the observations.
        venv: what the algorithm steps: the environments of all places, in their order.

    Raises:
        ValueError: there are more places than environments.
    """

    def __init__(self, task: TrainingTask, recipe: Hyperparameters) -> None:
        require_environments(recipe.num_envs, len(task.places))
        reward = PairedReward(task.reward) if recipe.paired else task.reward
        # the truth at the end of an episode is among what a step tells
        infos = "all" if recipe.truth_critic else "episode"
        self.envs = [
            MmWaveLocVectorEnv(
                n, **task.arguments(place), observation=task.observation, reward=reward,
                autoreset_mode="SameStep", infos=infos, threads=1,
            )
            for place, n in zip(
                task.places, shares(recipe.num_envs, len(task.places)), strict=True
            )
        ]  # fmt: skip
        self.observation = self.envs[0].observation
        self.features = len(self.observation)
        self.truth = TRUTH if recipe.truth_critic else 0
        self.adapters = [SB3VecEnv(env) for env in self.envs]
        parts: list[VecEnv] = [*self.adapters]
        if recipe.truth_critic:
            parts = [PrivilegedObservation(*of) for of in zip(parts, self.envs, strict=True)]
        venv = parts[0] if len(parts) == 1 else PlacesVecEnv(parts, self._ahead())
        venv = self.normal = VecNormalize(venv, norm_reward=False, clip_obs=recipe.clip_observation)
        self._stack: VecFrameStack | None = None
        if recipe.frames > 1:
            venv = self._stack = VecFrameStack(venv, recipe.frames)
        self.venv = venv

    def _ahead(self) -> list[int]:
        """How many epochs the places are ahead of the first: their episodes end by turns."""
        epochs = [cast(SimulatedSource, env.source).epochs for env in self.envs]
        return [k * length // len(epochs) for k, length in enumerate(epochs)]

    @property
    def seen(self) -> RunningMeanStd:
        """Mean and variance of the observations so far."""
        return cast(RunningMeanStd, self.normal.obs_rms)  # a dict of them for dict observations

    def hand_back(self, observations: Array) -> None:
        """Go on after epochs that ``venv`` did not see; the latest observations as it tells them.

        Of each of :attr:`adapters` its own ``restore`` is to be called.
        """
        if self._stack is not None:
            self._stack.stacked_obs.stacked_obs[:] = observations

    def state(self) -> dict[str, Any]:
        """All that what comes next depends on, for :meth:`restore`."""
        seen = self.seen
        places = zip(self.envs, self.adapters, strict=True)
        return {
            "places": {
                str(i): {"env": env.state(), "returns": adapter.state()}
                for i, (env, adapter) in enumerate(places)
            },
            "normal": {"mean": seen.mean, "var": seen.var, "count": np.float64(seen.count)},
            "stack": {} if self._stack is None else {"of": self._stack.stacked_obs.stacked_obs},
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on, to the last bit, as the world that gave this :meth:`state`."""
        for i, (env, adapter) in enumerate(zip(self.envs, self.adapters, strict=True)):
            place = state["places"][str(i)]
            env.restore(place["env"])
            adapter.restore(place["returns"])
        seen = self.seen
        seen.mean, seen.var = state["normal"]["mean"], state["normal"]["var"]
        seen.count = float(state["normal"]["count"])
        if self._stack is not None:
            self._stack.stacked_obs.stacked_obs[:] = state["stack"]["of"]
