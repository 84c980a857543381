"""The environments of a training, stepped together without a dictionary for each of them."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from experiments.training.training_env import TrainingEnv, how_wrong
from mmwave_env.numerics.arrays import Index, Mask

Observations = NDArray[np.float32]
Told = dict[str, Any]


class Ends(NamedTuple):
    """Episodes that ended with a step.

    Attributes:
        where: (k,) their environments.
        observations: (k, features), the last ones.
        truncated: (k,) True where an episode was cut off: the value of what would follow counts.
        infos: what Stable-Baselines3 calls the info of each.
    """

    where: Index
    observations: Observations
    truncated: Mask
    infos: list[Told]


class NativeSteps:
    """Steps the environments of all places of a world.

    Between :meth:`take_over` and :meth:`hand_back` they are stepped here, else by the world's own
    ``venv``.

    Args:
        world: whose environments they are.

    Attributes:
        observations: (n, features), with the truth where the critic sees it.
        rewards: (n,) of the latest step.
        over: (n,) where an episode ended with it.
    """

    def __init__(self, world: TrainingEnv) -> None:
        counts = [env.num_envs for env in world.envs]
        n, features = sum(counts), world.features
        ends = np.cumsum(counts).tolist()
        self._at = [slice(end - count, end) for end, count in zip(ends, counts, strict=True)]
        self._world, self._begun_s = world, time.time()
        self._told: list[Told] = [{} for _ in world.envs]
        self._seen = np.zeros((n, features), np.float32)
        self.observations = self._seen
        if world.truth:
            self.observations = np.zeros((n, features + world.truth), np.float32)
        self.rewards, self._returns = np.zeros((2, n))
        self._lengths = np.zeros(n, np.int64)
        self._terminated, self._truncated, self.over = np.zeros((3, n), np.bool_)

    def take_over(self) -> None:
        """Go on with the episodes that are under way in the world."""
        for at, adapter in zip(self._at, self._world.adapters, strict=True):
            state = adapter.state()
            self._returns[at], self._lengths[at] = state["returns"], state["lengths"]

    def hand_back(self) -> None:
        """Let the world know what became of them."""
        for at, adapter in zip(self._at, self._world.adapters, strict=True):
            adapter.restore({"returns": self._returns[at], "lengths": self._lengths[at]})

    def step(self, actions: Index) -> Ends | None:
        """Take actions (n,); the episodes that ended, if any did."""
        for i, (at, env) in enumerate(zip(self._at, self._world.envs, strict=True)):
            out = (
                self._seen[at], self.rewards[at], self._terminated[at], self._truncated[at]
            )  # fmt: skip
            *_, self._told[i] = env.step(actions[at], out=out)
        if self._world.truth:
            self._add_truth()
        self._returns += self.rewards
        self._lengths += 1
        np.logical_or(self._terminated, self._truncated, out=self.over)
        return self._ends() if np.count_nonzero(self.over) else None

    def _add_truth(self) -> None:
        features = self._world.features
        self.observations[:, :features] = self._seen
        for at, env in zip(self._at, self._world.envs, strict=True):
            parts = env.batch.at
            self.observations[at, features:] = how_wrong(
                env.batch.read(parts.x), env.batch.read(parts.truth)
            )

    def _ends(self) -> Ends:
        where = np.flatnonzero(self.over)
        seen, infos = [], []
        for at, told in zip(self._at, self._told, strict=True):
            final = told.get("final_info", {})
            keys = [key for key in final if f"_{key}" in final]
            for i in np.flatnonzero(self.over[at]).tolist():
                last = told["final_obs"][i]
                if self._world.truth:
                    estimate, truth = final["estimate"][i], final["truth"][i]
                    last = np.append(last, how_wrong(estimate[None], truth[None])[0])
                seen.append(last)
                episode = {
                    "r": float(self._returns[at][i]), "l": int(self._lengths[at][i]),
                    "t": round(time.time() - self._begun_s, 6),
                }  # fmt: skip
                infos.append({key: final[key][i] for key in keys} | {"episode": episode})
        self._returns[where], self._lengths[where] = 0.0, 0
        truncated = self._truncated[where] & ~self._terminated[where]
        return Ends(where, np.array(seen), truncated, infos)
