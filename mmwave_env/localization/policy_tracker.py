"""A track in which a policy chooses the mode in every epoch; no ground truth is needed.

Each epoch is filtered once: all modes run, the policy chooses, and the belief follows. The numbers
are the same as in an environment. A policy that corrects beliefs then reads the updated belief.
"""

from collections.abc import Sequence

import numpy as np

from mmwave_env.engines.engine import Engine
from mmwave_env.engines.play import play
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, MODE
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import Switching
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode


class PolicyTracker:
    """One track in which a policy chooses an action in every epoch, as in an environment.

    Args:
        pipeline: modes and layout.
        switching: the policy, and what it observes.

    Raises:
        ValueError: the policy corrects beliefs that the modes share.
    """

    def __init__(self, pipeline: Pipeline, switching: Switching) -> None:
        assert switching.policy
        bank = switching.bank
        table = Observation(pipeline, switching.observation, switching.beliefs)
        self._policy = switching.policy(table)
        action = self._policy.action
        if action != MODE and not bank:
            raise ValueError(f'policy: found {action} for a shared belief, expected "per-mode"')
        self._engine = Engine(
            pipeline, 1, None, switching.observation, bank, action=action, predicted=bank is None
        )
        self._corrects = action == CORRECTION
        self._starts = True

    def load(self, episodes: Sequence[Episode], go_on: bool = False) -> None:
        """Load one episode, in the same way as :meth:`Engine.load`."""
        self._engine.load(episodes, go_on=go_on)
        self._starts = not go_on

    def load_epoch(self, incoming: Sequence[float], time_s: float) -> None:
        """Load one more epoch of the track, as :meth:`Engine.load_epoch` does."""
        self._engine.load_epoch(incoming, time_s)
        self._starts = False

    def run(self, *names: str) -> dict[str, Array]:
        """Filter the loaded episode once, in the same way as :meth:`Engine.run`.

        If the policy corrects beliefs, the parts "corrected_x" and "corrected_P" are the corrected
        belief, and "trusted" is the factor by which the correction was scaled.
        """
        if self._starts:
            self._policy.reset(np.array([True]))
        corrected = {"reported.x": "corrected_x", "reported.P": "corrected_P"}
        wanted = (*names, *corrected) if self._corrects else names
        epochs = int(self._engine.state.length[0])
        played = play(self._engine, self._policy, epochs, wanted, scored=False)
        parts = played.outputs
        if self._corrects:
            parts |= {to: parts.pop(name) for name, to in corrected.items()}
            parts["trusted"] = played.trusted.astype(float)
        return parts
