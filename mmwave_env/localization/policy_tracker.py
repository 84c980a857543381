"""A track in which a policy chooses the mode in every epoch; no ground truth is needed.

First, an environment's engine steps through the episode, and the policy chooses actions. Then
an engine for whole tracks runs the episode with these actions. Both engines compute exactly the
same numbers, so the track is the same as in an environment.
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.imm_engine import ImmTracker
from mmwave_env.engines.track_engine import EpisodeFilter, Tracker
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode


class Choice(Protocol):
    """A policy like :class:`policies.policy.Policy`, which this package does not import."""

    def reset(self, mask: NDArray[np.bool_]) -> None: ...  # noqa: D102
    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.int64]: ...  # noqa: D102


class PolicyTracker:
    """One track in which a policy chooses an action in every epoch, as in an environment.

    Args:
        pipeline: modes and layout.
        policy: function from observations (1, features) to actions (1,), with a method
            ``reset(mask)`` that is called when a track starts over. A policy that corrects beliefs
            also has the methods ``read_from_track`` and ``correct_track`` of
            :class:`policies.corrector.Corrector`.
        observation: kind of observation: "full", "prior" or "signed".
        bank: modes and transition probabilities, if every mode keeps its own belief; else None.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        policy: Choice,
        observation: str = "full",
        bank: Bank | None = None,
    ) -> None:
        self._engine = Engine(pipeline, 1, TrackingReward(), observation, bank)
        self._correct = getattr(policy, "correct_track", None)
        if self._correct:
            policy.read_from_track(pipeline)  # type: ignore[attr-defined]
        self._filter: Tracker | ImmTracker = (
            ImmTracker(bank, pipeline.layout, 1, pipeline.planar, True, self._correct is not None)
            if bank
            else Tracker(pipeline, 1)
        )
        self._observed = EpisodeFilter(self._engine.batch)
        self._policy = policy
        self._pipeline = pipeline
        self._action = 0
        self._starts = True

    def load(self, episodes: Sequence[Episode], go_on: bool = False) -> None:
        """Load one episode, in the same way as :meth:`Tracker.load`."""
        self._filter.load(episodes, go_on)
        self._observed.load(episodes, go_on)
        self._starts = not go_on

    def load_epoch(self, incoming: Sequence[float], time_s: float) -> None:
        """Load one more epoch of the track, as :meth:`Tracker.load_epoch` does."""
        self._filter.load_epoch(incoming, time_s)
        self._observed.load_epoch(incoming, time_s)
        self._starts = False

    def run(self, *names: str) -> dict[str, Array]:
        """Filter the loaded episode once, in the same way as :meth:`Tracker.run`.

        If the policy corrects beliefs, the parts "corrected_x" and "corrected_P" are the corrected
        belief, and "trusted" is the factor by which the correction was scaled.
        """
        if self._starts:
            self._policy.reset(np.array([True]))
        epochs = self._filter.epochs
        actions = np.empty((1, epochs), np.int64)
        for t in range(epochs):
            # The first epoch of an episode ignores the action.
            observations, _ = self._engine.step(np.int64(self._action))
            (self._action,) = actions[:, t] = self._policy(observations)
        if not self._correct:
            return self._filter.run(*names, actions=actions)
        parts = self._filter.run(*dict.fromkeys((*names, "x", "P", "signed")), actions=actions)
        corrections = [self._correct(signed[None]) for signed in parts.pop("signed")[0]]
        shift, log_factor, trusted = (
            np.array(each).swapaxes(0, 1) for each in zip(*corrections, strict=True)
        )
        before = parts["x"], parts["P"], shift, log_factor
        if epochs == 1:  # numbers are faster than arrays of one number
            before = tuple(part[0, 0] for part in before)
        belief = corrected_all(*before, self._pipeline)
        x = np.array(belief.x).T.reshape(1, epochs, -1)
        P = np.array(pack(belief.P)).T.reshape(1, epochs, -1)
        return parts | {"corrected_x": x, "corrected_P": P, "trusted": trusted}
