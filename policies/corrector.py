"""A corrector with memory: a recurrent network that corrects the beliefs of a bank of filters.

After every update, the network reads residuals and beliefs, and returns a correction of the
position and factors for its standard deviations. Only the output is corrected: the filters continue
from their own beliefs. The filters are combined by the *base*, which is a switcher (a policy that
chooses modes) or an IMM. If features are outside the range that the network saw in training,
corrections are scaled down: the farther outside the features are, the closer to zero.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import Repeated, Stages
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION
from mmwave_env.interface.observation import Observation, observation_columns
from mmwave_env.interface.policy import (
    CompiledPolicy,
    Correction,
    FixedMode,
    Policy,
    Switching,
)
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import AnyPath
from mmwave_env.numerics.numbers import Array32, Index, Mask
from policies.learned import LearnedPolicy, LearnedSwitch, policy_file
from policies.network import (
    Network,
    Unit,
    correct_epoch,
    correct_track,
    layer_in,
    mean_and_differences,
    play_epochs,
)
from policies.policy_file import CORRECTIONS, PolicyFile

BASE_IMM = "imm-best"  # the name of the base if it is the IMM of the policy's bank
# file of the shipped two-way corrector, in a folder of its own because it is no policy
TWO_WAY = Path(__file__).with_name("data") / "smoothing" / "two-way.safetensors"


def base_policy(base: str, observation: Observation | None = None) -> Policy:
    """Return the policy of a base, which reads these observations; an IMM stays as it is."""
    return FixedMode() if base == BASE_IMM else LearnedSwitch(base, observation)


def network_of(file: PolicyFile, *recurrent: str) -> Network:
    """Return the network of a file that has the recurrent units with these names.

    Raises:
        ValueError: the file is for a switcher, or for the other kind of tracks.
    """
    tensors, card, path = file
    if not card.base:
        raise ValueError(f"{path}: found a switcher, expected a corrector")
    reads_back = "back.bias_hh" in tensors
    if reads_back != ("back" in recurrent):
        kind = "smoothed" if reads_back else "filtered"
        raise ValueError(f"{path}: found a corrector of {kind} tracks, expected the other kind")
    units = [Unit(layer_in(tensors, u, "_ih"), layer_in(tensors, u, "_hh")) for u in recurrent]
    out = layer_in(tensors, "out")
    return Network(
        front=layer_in(tensors, "front"),
        units=tuple(units),
        head=layer_in(tensors, "head"),
        out=mean_and_differences(out.weight, out.bias),
    )


class Corrector(LearnedPolicy, CompiledPolicy):
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
        file = policy_file(path)
        self._network = network_of(file, "gru")
        self._run = Repeated(correct_epoch)
        self._play = Repeated(play_epochs)
        self._base = base_policy(file.card.base)
        super().__init__(file, observation)

    def read_from(self, observation: Observation) -> None:
        """Find the features of the corrector and of its base in the observations."""
        super().read_from(observation)
        self._base = base_policy(self.card.base, observation)

    def reset(self, mask: Mask) -> None:
        """Forget the past of environments where ``mask`` is True, as a new episode begins."""
        self._begin(len(mask))
        hidden, trust = self.memory
        hidden[mask] = 0.0
        trust[mask] = 1.0

    def _begin(self, n: int) -> None:
        """Begin n new tracks, unless there are n: make hidden units and the trust of each."""
        if not self.memory or n != len(self.memory[1]):
            units = len(self._network.units[0].of_state.weight)
            self.memory = np.zeros((n, units), np.float32), np.ones(n, np.float32)

    def act(self, observation: Array32) -> Index:
        """Return the base's actions (n,) for observations (n, features)."""
        return self._base.act(observation)

    def correct(self, observation: Array32) -> Correction:
        """Return corrections of the beliefs after the latest epoch; update the network's memory.

        Call this once after every step, with the observations (n, features) of the step. If their
        number is not that of the last call, new tracks begin.
        """
        observations = self._checked(observation)
        n = len(observations)
        self._begin(n)
        answers = np.empty((n, CORRECTIONS), np.float32)
        trusted = np.empty(n, np.float32)
        self._run(
            [(0, n)], 1, observations, self.sight, self._network, *self.memory, answers, trusted
        )
        return Correction(answers[:, :3], answers[:, 3:], trusted)

    def play(self, stages: Stages, *played: NDArray[Any]) -> bool:
        """Play the next epochs (:class:`~mmwave_env.interface.policy.CompiledPolicy`)."""
        base = self._base
        if type(self) is not Corrector or not isinstance(base, LearnedSwitch):
            return False  # a user's subclass may act and correct otherwise
        self._begin(len(played[0]))
        self._play(
            [(0, len(stages.states[0].rows))], 1, stages, base.sight, base.layers, self.sight,
            self._network, *self.memory, *played,
        )  # fmt: skip
        return True


class TwoWayCorrector(LearnedPolicy):
    """A corrector of smoothed tracks, which reads each track forwards and backwards.

    It is a :data:`~mmwave_env.interface.policy.TrackCorrector`.
    """

    def __init__(self, path: AnyPath | PolicyFile) -> None:
        super().__init__(path)
        self._network = network_of(self._file, "gru", "back")

    def __call__(self, pipeline: Pipeline, features: Array32) -> Correction:
        """Return corrections (n, T, 3) of n smoothed tracks, given all features of a pipeline.

        :func:`~mmwave_env.engines.smoothing.smoothed_features` computes them (n, T, features).
        """
        self._find_in(observation_columns(after_update(pipeline)))
        n, epochs, _ = features.shape
        answers = np.empty((n, epochs, CORRECTIONS), np.float32)
        trusted = np.empty((n, epochs), np.float32)
        for i in range(n):
            correct_track(features[i], self.sight, self._network, answers[i], trusted[i])
        return Correction(answers[..., :3], answers[..., 3:], trusted)


def load(path: AnyPath | PolicyFile, radio: str = "handset") -> Switching:
    """Return the policy in a file, or a shipped policy, with its modes for a radio profile.

    ```python
    >>> tracker = Tracker("street", load("corrector", "standard"), "standard")

    ```
    """
    file = policy_file(path)
    kind = Corrector if file.card.base else LearnedSwitch
    policy = kind(file)
    filters = policy.bank(radio) if policy.beliefs == "per-mode" else policy.modes
    return Switching(filters, None, partial(kind, file), file.card.observation)
