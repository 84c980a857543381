"""Tracks in which a policy chooses the mode in every epoch; no ground truth is needed.

Each epoch is filtered once: all modes run, the policy chooses, and the belief follows. The numbers
are the same as in an environment. A policy that corrects beliefs then reads the updated belief.
"""

from typing import Any

import numpy as np

from mmwave_env.engines.batch import ALL, Places
from mmwave_env.engines.engine import Engine, play
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import Switching
from mmwave_env.numerics.numbers import Array, Array32


class PolicyTracker(Engine):
    """Tracks in which a policy chooses an action in every epoch, as in an environment.

    Args:
        pipeline: modes and layout.
        switching: the policy, and what it observes.
        n: number of tracks.

    Raises:
        ValueError: the policy corrects beliefs that the modes share.
    """

    def __init__(self, pipeline: Pipeline, switching: Switching, n: int) -> None:
        assert switching.policy
        bank = switching.bank
        table = Observation(pipeline, switching.observation, switching.beliefs)
        self._policy = switching.policy(table)
        action = self._policy.action
        if action != MODE and not bank:
            raise ValueError(f'policy: found {action} for a shared belief, expected "per-mode"')
        super().__init__(
            pipeline, n, None, switching.observation, bank, action=action, predicted=bank is None
        )
        self.restart(ALL)

    @property
    def memory(self) -> tuple[Array32, ...]:  # type: ignore[override]
        """Return the policy's memory, in which tracks of another engine can be set."""
        return self._policy.memory

    def restart(self, places: Places) -> None:
        """Start over with the loaded episodes of all tracks; the policy forgets the past."""
        super().restart(places)
        self._policy.reset(np.ones(self.n, np.bool_))

    def run(self, *names: str, actions: Any = None) -> dict[str, Array]:
        """Filter the loaded episodes once, in the same way as :meth:`Engine.run`.

        If the policy corrects beliefs, "reported.x" and "reported.P" are the corrected belief, and
        "trusted" is the factor by which the correction was scaled.
        """
        corrects = self._policy.action == CORRECTION
        wanted = (*names, "reported.x", "reported.P") if corrects else names
        played = play(self, self._policy, int(self.state.length[0]), wanted, scored=False)
        if corrects:
            played.outputs["trusted"] = played.trusted.astype(float)
        return played.outputs
