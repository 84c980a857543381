"""Environments at several places, with rollouts that measure the value of every action."""

from typing import NamedTuple

import numpy as np

from experiments.evaluation.branches import Act, Branches
from experiments.training.training_task import TrainingTask
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.epoch import untuned
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.world.keys import Streams
from policies.sb3 import Normalization

CONSTANT = 1e-4  # added to standard deviations, which are 0 for a feature that never changes


class Tried(NamedTuple):
    """States in which every action was tried.

    Attributes:
        observations: (k, features) observations in the states.
        values: (k, actions) sum of the discounted rewards of an action and the actions after it.
    """

    observations: Array32
    values: Array


class RolloutEnv:
    """A set of n environments at the places of a task; a place is a scene with a radio.

    A group of eight adjacent environments has one place, and all eight are in the same epoch. The
    groups' first episodes are cut to different lengths, so that later their epochs differ.

    Args:
        task: task of the training.
        n: number of environments, a multiple of eight, and at least eight per place.
        horizon: length of a rollout, epochs.
        discount: weight of a reward that comes one second later, 0 to 1.
        seed: seed of the first environment; the other seeds count up from it.

    Attributes:
        observation: definition of the observed features.
        observations: (n, features) observations of the current states.

    Raises:
        ValueError: the places can't share a program.
    """

    def __init__(
        self, task: TrainingTask, n: int, horizon: int, discount: float, seed: int
    ) -> None:
        places = task.places
        self._sources = [place.source(task.scenario) for place in places]
        self._horizon = horizon
        self._everyone = np.arange(n)
        block = self._everyone // WIDTH
        self._place = block % len(places)
        pipelines = [
            Pipeline(task.banks[place.profile].modes, source.layout)
            for place, source in zip(places, self._sources, strict=True)
        ]
        pipeline = pipelines[0]
        if any(untuned(other) != untuned(pipeline) for other in pipelines):
            raise ValueError(
                "places: found several kinds of clock, algorithms or safeguards, expected one kind "
                "of clock, and modes that differ only in process noise and in the size of "
                "acceleration_mps2 and turn_rate_radps"
            )
        bank = task.bank if task.beliefs == "per-mode" else None
        self._engine = Engine(pipeline, n, task.reward, task.observation, bank)
        self.observation = self._engine.observation
        self._branches = Branches(self._engine, horizon)
        if bank:
            for i, place in enumerate(places):
                here = np.flatnonzero(self._place == i)
                self._engine.tune(task.banks[place.profile], here)
        step_s = np.array([place.dt for place in places])[self._place]
        self._weights = discount ** (step_s[:, None] * np.arange(horizon))
        self._streams = Streams(n)
        for i in range(n):
            self._streams.seed(i, seed + i)
        self.observations = np.zeros((n, len(self.observation)), np.float32)
        self._begin(self._everyone)
        length = self._engine.state.length
        length[:] = 1 + block * (length - 1) // (block[-1] + 1)

    def step(self, actions: Index) -> None:
        """Take the actions (n,), one in every environment; start a new episode where one ends."""
        self.observations, _ = self._engine.step(actions)
        state = self._engine.state
        over = np.flatnonzero(state.epoch > state.length)
        if len(over):
            self._begin(over)

    def _begin(self, some: Index) -> None:
        """Start new episodes in the environments with the indices ``some`` (k,)."""
        for i, source in enumerate(self._sources):
            here = some[self._place[some] == i]
            if len(here):
                self._engine.load(source.sample_batch(self._streams.keys(here)), here)
        begun, _ = self._engine.start(some)
        self.observations[some] = begun[some]

    def measured_normalization(self, clip: float) -> Normalization:
        """Take action 0 for the length of an episode; return the observations' normalization.

        Args:
            clip: number of standard deviations from the mean at which observations are clipped.
        """
        parts = []
        for _ in range(max(source.epochs for source in self._sources)):
            self.step(np.zeros(len(self._everyone), np.int64))
            parts.append(self.observations)
        observations = np.concatenate(parts)
        mean = observations.mean(0)
        sigma = observations.std(0) + CONSTANT
        return Normalization.clipped(mean, sigma, clip)

    def try_all(self, act: Act) -> Tried:
        """Try every action in each environment whose episode goes on for at least the horizon.

        Args:
            act: function that chooses the actions after the tried action, given observations
                (actions * n, features) of copies of the environments: first the n copies that
                began with action 0, then the n copies that began with action 1, and so on.
        """
        values = self._branches.values(act, self._weights)
        state = self._engine.state
        whole = state.epoch - 1 + self._horizon <= state.length
        return Tried(self.observations[whole], values[whole])
