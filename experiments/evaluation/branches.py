"""Branches of environments, in which every action is tried, and a policy that knows the truth.

The world does not depend on actions. So all branches of an environment have the same measurements
(common random numbers). Values of actions then differ only because of the actions, not because of
different noise.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.agents import Act
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import rows_of
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.engine import Engine
from mmwave_env.interface.policy import FixedMode, Policy
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.world.episode import columns_of

CLAIRVOYANT = "clairvoyant"
HORIZON_S = 15.0  # how far the clairvoyant looks ahead; later rewards hardly depend on an action
BLIND = (
    f"policy: found {CLAIRVOYANT} where the truth is unknown, expected another policy; "
    f"{CLAIRVOYANT} works only in comparisons on episodes with true positions"
)


class Branches:
    """Copies of an engine's n environments, one set per action, that run ahead of the originals.

    Args:
        engine: engine that has loaded whole episodes, so that coming epochs can be copied.
        horizon: number of epochs to run ahead.
    """

    def __init__(self, engine: Engine, horizon: int) -> None:
        self._batch = engine
        self.horizon = horizon
        self._actions = len(engine.observation.actions)
        at = engine.at
        # State is kept in blocks of WIDTH environments; the last block is copied even if not full.
        n = self._actions * len(engine.state.rows) * WIDTH
        self._copies = Batch(
            engine.program, engine.layout, n, rows_of(at.action), rows_of(at.observation)
        )
        self._copies.make_room(horizon)
        self._copies.state.length[:] = horizon
        self._io = self._copies.io(rows_of(at.reward))

    def values(self, act: Act, weights: NDArray[np.floating[Any]] | float) -> Array:
        """Try every action in the current state of every environment.

        Args:
            act: function from observations (copies, features) to actions, for all epochs but the
                first. Copies are ordered by their first actions: all copies with 0, then 1, ...
            weights: (n, horizon) weights of the rewards, or one weight.

        Returns:
            The sums (n, actions) of weighted rewards; nothing is added after an episode's end.
        """
        state = self._batch.state
        copies = self._copies.state
        io = self._io
        ahead = state.epoch[:, None] + np.arange(self.horizon)
        # Past the end of an episode, its last epoch is repeated with weight 0.
        weights = np.where(ahead - 1 < state.length[:, None], weights, 0.0)
        some = np.minimum(np.arange(len(state.rows) * WIDTH), len(ahead) - 1)
        epochs = np.minimum(ahead, state.length[:, None] - 1)[some]
        coming = state.table[some[:, None], epochs]
        copies.table.reshape(self._actions, *coming.shape)[:] = coming
        copies.rows.reshape(self._actions, *state.rows.shape)[:] = state.rows
        copies.epoch[:] = 0
        values = np.zeros((self._actions, len(some)))
        taken = np.repeat(np.arange(self._actions), len(some))
        for weight in weights[some].T:
            io.inputs[:, 0, 0] = taken
            self._copies.advance(io)
            values += weight * io.outputs[:, 0, 0].reshape(values.shape)
            taken = act(io.observations[:, 0])
        return values.T[: len(ahead)]


class Clairvoyant(Policy):
    """A policy that knows the truth; its reward is the ceiling for policies that choose modes.

    In every epoch it tries each action (raising the probability of one mode, or of none) on the
    same measurements, followed by action 0 in all later epochs. It chooses the action with the
    largest sum of rewards within :data:`HORIZON_S`. It knows future noise, as no other policy does.
    """

    _branches: Branches | None = None

    def foresee(self, engine: Engine) -> None:
        """Prepare to look ahead in the episodes that an engine has just loaded.

        Raises:
            ValueError: an episode has no truth.
        """
        state = engine.state
        if not np.isfinite(state.table[:, 0, columns_of(engine.layout).truth]).all():
            raise ValueError(BLIND)
        step_s = engine.steps_s(np.arange(len(state.length))).min()
        horizon = min(math.ceil(HORIZON_S / step_s - 1e-6), state.table.shape[1])
        self._branches = Branches(engine, horizon)

    def act(self, observation: Array32) -> Index:
        """Return actions (n,)."""
        if self._branches is None:
            raise ValueError(BLIND)
        best: Index = self._branches.values(FixedMode().act, 1.0).argmax(axis=1)
        return best
