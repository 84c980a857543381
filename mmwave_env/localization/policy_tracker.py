"""A track in which a policy chooses the mode in every epoch; no ground truth is needed.

First, an environment's engine steps through the episode, and the policy chooses actions. Then
an engine for whole tracks runs the episode with these actions. Both engines compute exactly the
same numbers, so the track is the same as in an environment.
"""

from collections.abc import Sequence

import numpy as np

from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.imm_engine import ImmTracker
from mmwave_env.engines.track_engine import EpisodeFilter, Tracker
from mmwave_env.filters.correction import corrected_all
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.policy import Correction, Switching
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.interface.signed import after_update
from mmwave_env.numerics.linalg import pack
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
        self._engine = Engine(pipeline, 1, TrackingReward(), switching.observation, bank)
        table = self._engine.observation
        self._policy = switching.policy(table)
        if self._policy.corrects and not bank:
            raise ValueError('policy: found corrections of a shared belief, expected "per-mode"')
        self._filter: Tracker | ImmTracker = Tracker(pipeline, 1)
        if bank:
            self._filter = ImmTracker(
                bank, pipeline.layout, 1, pipeline.planar, acted=True, signed=self._policy.corrects
            )
        # columns of observations that are known after an update, and their features' indices
        after = [feature.name for feature in after_update(pipeline, per_mode=bank is not None)]
        self._known = [i for i, name in enumerate(table.names) if name in after]
        self._signed = [after.index(table.names[i]) for i in self._known]
        self._observed = EpisodeFilter(self._engine.batch)
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
            (self._action,) = actions[:, t] = self._policy.act(observations)
        if not self._policy.corrects:
            return self._filter.run(*names, actions=actions)
        parts = self._filter.run(*dict.fromkeys((*names, "x", "P", "signed")), actions=actions)
        corrections = self._corrections(parts.pop("signed")[0])
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

    def _corrections(self, signed: Array) -> list[Correction]:
        """Return the policy's corrections after each epoch, given the signed features (T, k)."""
        observations = np.full((len(signed), 1, len(self._engine.observation)), np.nan, np.float32)
        observations[:, 0, self._known] = signed[:, self._signed]
        corrections = []
        for observation in observations:
            correction = self._policy.correct(observation)
            assert correction is not None
            corrections.append(correction)
        return corrections
