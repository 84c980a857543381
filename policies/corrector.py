"""A corrector with memory: a recurrent network that corrects the beliefs of a bank of filters.

After every update, the network reads residuals and beliefs, and returns a correction of the
position and factors for its standard deviations. Only the output is corrected: the filters continue
from their own beliefs. The filters are combined by the *base*, which is a switcher (a policy that
chooses modes) or an IMM. If features are outside the range that the network saw in training,
corrections are scaled down: the farther outside the features are, the closer to zero.
"""

from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import ClassVar

import numpy as np

from mmwave_env.filters.correction import MOST_LOG_FACTOR, MOST_SHIFT
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION
from mmwave_env.interface.observation import Observation, observation_columns
from mmwave_env.interface.policy import Correction, FixedMode, Policy, Switching
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import AnyPath
from mmwave_env.numerics.numbers import Array32, Index, Mask
from policies.learned import LearnedPolicy, LearnedSwitch, policy_file, taken
from policies.network import (
    Network,
    Unit,
    correct_epoch,
    correct_track,
    layer_in,
    mean_and_differences,
)
from policies.policy_file import CORRECTIONS, PolicyFile

BASE_IMM = "imm-best"  # the name of the base if it is the IMM of the policy's bank
# file of the shipped two-way corrector, in a folder of its own because it is no policy
TWO_WAY = Path(str(files("policies").joinpath("data", "smoothing", "two-way.safetensors")))


class CorrectionNetwork(LearnedPolicy):
    """The network of a policy file that corrects beliefs.

    Arguments, attributes and errors: same as for :class:`~policies.learned.LearnedPolicy`.
    """

    recurrent: ClassVar[tuple[str, ...]] = ("gru",)  # names of the recurrent units in the file

    def __init__(self, path: AnyPath | PolicyFile) -> None:
        super().__init__(path)
        tensors = self._tensors
        if not self.card.base:
            raise ValueError(f"{self._path}: found a switcher, expected a corrector")
        reads_back = "back.bias_hh" in tensors
        if reads_back != ("back" in self.recurrent):
            kinds = ["filtered", "smoothed"]
            raise ValueError(
                f"{self._path}: found a corrector of {kinds[reads_back]} tracks, expected one of "
                f"{kinds[not reads_back]} tracks"
            )
        out = layer_in(tensors, "out")
        self._network = Network(
            low=self._low,
            high=self._high,
            front=layer_in(tensors, "front"),
            units=tuple(
                Unit(layer_in(tensors, name, "_ih"), layer_in(tensors, name, "_hh"))
                for name in self.recurrent
            ),
            head=layer_in(tensors, "head"),
            out=mean_and_differences(out.weight, out.bias),
            most=np.array([MOST_SHIFT] * 3 + [MOST_LOG_FACTOR] * 3, np.float32),
        )


class Corrector(CorrectionNetwork, Policy):
    """A policy that chooses the same actions as its base, and corrects the base's beliefs.

    ```python
    >>> policy = Corrector("corrector")
    >>> env = gym.make(
    ...     "mmwave_env:MmWaveLoc-v0", observation="signed",
    ...     beliefs=policy.beliefs, modes=policy.bank("handset"),
    ... )
    >>> policy.read_from(env.unwrapped.observation)

    ```

    Arguments, attributes and errors: same as for :class:`~policies.learned.LearnedPolicy`.
    """

    action = CORRECTION

    def __init__(self, path: AnyPath | PolicyFile, observation: Observation | None = None) -> None:
        super().__init__(path)
        base = self.card.base
        self._base = FixedMode() if base == BASE_IMM else LearnedSwitch(base)
        self._hidden = np.zeros((0, len(self._network.units[0].of_state.weight)), np.float32)
        self._trust = np.zeros(0, np.float32)
        if observation is not None:
            self.read_from(observation)

    def read_from(self, observation: Observation) -> None:
        """Find the features of the corrector and of its base in the observations."""
        super().read_from(observation)
        if isinstance(self._base, LearnedSwitch):
            self._base.read_from(observation)

    def reset(self, mask: Mask) -> None:
        """Forget the past of environments where ``mask`` is True, as a new episode begins."""
        if len(mask) != len(self._hidden):
            self._hidden = np.zeros((len(mask), self._hidden.shape[1]), np.float32)
            self._trust = np.ones(len(mask), np.float32)
        self._hidden[mask] = 0.0
        self._trust[mask] = 1.0
        self._base.reset(mask)

    @property
    def memory(self) -> tuple[Array32, ...]:  # type: ignore[override]
        """Return the memory of the network: its hidden units, and its trust."""
        return self._hidden, self._trust

    def act(self, observation: Array32) -> Index:
        """Return the base's actions (n,) for observations (n, features)."""
        return self._base.act(observation)

    def correct(self, observation: Array32) -> Correction:
        """Return corrections of the beliefs after the latest epoch; update the network's memory.

        Call this once after every step, with the observations (n, features) of the step.
        """
        features = self.features_in(observation)
        n = len(features)
        answers = np.empty((n, CORRECTIONS), np.float32)
        trusted = np.empty(n, np.float32)
        correct_epoch(features, self._network, self._hidden, self._trust, answers, trusted)
        return Correction(answers[:, :3], answers[:, 3:], trusted)


class TwoWayCorrector(CorrectionNetwork):
    """A corrector of smoothed tracks, which reads each track forwards and backwards."""

    recurrent = ("gru", "back")

    def read_from_track(self, pipeline: Pipeline) -> None:
        """Find the policy's features among the features that tracks of a pipeline compute."""
        columns = observation_columns(after_update(pipeline, per_mode=True))
        self._of_track = self._found_in(columns)

    def correct_tracks(self, features: Array32) -> Correction:
        """Return corrections (n, T, 3) of n smoothed tracks, given all their features.

        :func:`~mmwave_env.engines.smoothing.smoothed_features` computes the features
        (n, T, features); :meth:`read_from_track` must have been called for their pipeline.
        """
        n, epochs, width = features.shape
        read = taken(features.reshape(-1, width), *self._of_track).reshape(n, epochs, -1)
        answers = np.empty((n, epochs, CORRECTIONS), np.float32)
        trusted = np.empty((n, epochs), np.float32)
        for track in zip(read, answers, trusted, strict=True):
            correct_track(track[0], self._network, *track[1:])
        return Correction(answers[..., :3], answers[..., 3:], trusted)


def learned_policy(path: AnyPath | PolicyFile) -> LearnedSwitch | Corrector:
    """Return the switcher or the corrector in a policy file, given by its path or shipped name."""
    file = policy_file(path)
    return Corrector(file) if file.card.base else LearnedSwitch(file)


def load(path: AnyPath, radio: str = "handset") -> Switching:
    """Return the policy in a file, or a shipped policy, with its modes for a radio profile.

    ```python
    >>> tracker = Tracker("street", load("corrector", "standard"), "standard")

    ```
    """
    file = policy_file(path)
    policy = learned_policy(file)
    filters = policy.bank(radio) if policy.beliefs == "per-mode" else policy.modes
    return Switching(filters, None, partial(type(policy), file), file.card.observation)
