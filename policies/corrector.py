"""A corrector with memory: a recurrent network that corrects the beliefs of a bank of filters.

After every update, the network reads residuals and beliefs, and returns a correction of the
position and factors for its standard deviations. Only the output is corrected: the filters continue
from their own beliefs. The filters are combined by the *base*, which is a switcher (a policy that
chooses modes) or an IMM. If features are outside the range that the network saw in training,
corrections are scaled down, far outside the range almost to zero.
"""

from typing import NamedTuple

import numpy as np

from mmwave_env.filters.correction import MOST_LOG_FACTOR, MOST_SHIFT
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import Observation, columns_of
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import AnyPath
from mmwave_env.numerics.numbers import Array32, Index, Mask
from policies.learned import LearnedPolicy, LearnedSwitch, taken
from policies.policy import Policy
from policies.policy_file import CORRECTIONS

BASE_IMM = "imm-best"  # the name of the base if it is the IMM of the policy's bank
# "Trust" is the factor, 0 to 1, by which corrections are scaled.
RANGE_FADE = 2.0  # trust is exp(-2 d) if a feature is d standard deviations outside its range
RECOVERY = 0.1  # maximum growth of trust per epoch, as the network remembers unusual features
# The network is an ensemble, whose members compute different shifts. If the spread of the shifts,
# in corrected standard deviations, is at most SPREAD[0], trust is not reduced; from SPREAD[1] on,
# trust is 0.
SPREAD = (0.5, 1.0)


class Correction(NamedTuple):
    """Corrections of n beliefs after the latest epoch (:mod:`mmwave_env.filters.correction`).

    Attributes:
        shift: (n, 3) shifts along and across the motion, and up, in standard deviations of the
            belief.
        log_factor: (n, 3) logarithms of factors for these standard deviations.
        trusted: (n,) trust, the factor, 0 to 1, by which the network's answer was scaled.
    """

    shift: Array32
    log_factor: Array32
    trusted: Array32


class Corrector(LearnedPolicy, Policy):
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

    def __init__(self, path: AnyPath, observation: Observation | None = None) -> None:
        super().__init__(path)
        base = self.card.base
        if not base:
            raise ValueError(f"{self._path}: found a switcher, expected a corrector")
        self._base = None if base == BASE_IMM else LearnedSwitch(base)
        tensors = self._tensors
        self._front, self._head = (
            (tensors[f"{name}.weight"].T.copy(), tensors[f"{name}.bias"])
            for name in ("front", "head")
        )
        self._out = _mean_and_differences(tensors["out.weight"].T, tensors["out.bias"])
        units = len(tensors["gru.bias_hh"]) // 3
        # (weight, bias) for input and for memory: of the gates (reset, update), then the candidate
        self._gates, self._candidate = (
            [(tensors[f"gru.weight_{name}"][rows].T.copy(), tensors[f"gru.bias_{name}"][rows])
             for name in ("ih", "hh")]
            for rows in (slice(2 * units), slice(2 * units, None))
        )  # fmt: skip
        # matrix that averages squared differences over the ensemble's members, for each direction
        members = (self._out[0].shape[1] - CORRECTIONS) // 3
        self._average = np.tile(np.eye(3, dtype=np.float32), (members, 1)) / np.float32(members)
        self._hidden = np.zeros((0, units), np.float32)
        self._trust = np.zeros(0, np.float32)
        if observation is not None:
            self.read_from(observation)

    def read_from(self, observation: Observation) -> None:
        """Find the features of the corrector and of its base in the observations."""
        super().read_from(observation)
        if self._base:
            self._base.read_from(observation)

    def reset(self, mask: Mask) -> None:
        """Forget the past of environments where ``mask`` is True, as a new episode begins."""
        if len(mask) != len(self._hidden):
            self._hidden = np.zeros((len(mask), self._hidden.shape[1]), np.float32)
            self._trust = np.ones(len(mask), np.float32)
        self._hidden[mask], self._trust[mask] = 0.0, 1.0
        if self._base:
            self._base.reset(mask)

    def __call__(self, observation: Array32) -> Index:
        """Return the base's actions (n,) for observations (n, features)."""
        if self._base is None:
            return np.zeros(len(observation), np.int64)
        return self._base(observation)

    def correct(self, observation: Array32) -> Correction:
        """Return corrections of the beliefs after the latest epoch; update the network's memory.

        Call this once after every step, with the observations (n, features) of the step.
        """
        return self.correct_features(self.features_in(observation))

    def read_from_track(self, pipeline: Pipeline) -> None:
        """Find the policy's features among the features that tracks of a pipeline compute."""
        columns = columns_of(after_update(pipeline, per_mode=True))
        self._of_track = self._found_in(columns)

    def correct_track(self, signed: Array32) -> Correction:
        """Return corrections of n tracks after an epoch, given their features (n, features)."""
        return self.correct_features(taken(signed.astype(np.float32), *self._of_track))

    def correct_features(self, features: Array32) -> Correction:
        """Return corrections, given the latest values of the network's features (n, features)."""
        inside = np.fmin(np.fmax(features, self._low), self._high)  # NaN becomes the low limit
        beyond = np.abs(features - inside).max(axis=1)
        strange = np.fmax(np.exp(-RANGE_FADE * beyond), 0.0)  # 0 if a feature is NaN
        self._trust = np.minimum(strange, self._trust + np.float32(RECOVERY))
        weight, bias = self._front
        front = np.tanh(inside @ weight + bias)
        self._hidden = hidden = self._remembering(front)
        weight, bias = self._head
        units = hidden.shape[1]
        head = np.tanh(hidden @ weight[:units] + front @ weight[units:] + bias)
        weight, bias = self._out
        out = head @ weight + bias
        shift = np.minimum(np.maximum(out[:, :3], -MOST_SHIFT), MOST_SHIFT)
        log_factor = np.minimum(np.maximum(out[:, 3:6], -MOST_LOG_FACTOR), MOST_LOG_FACTOR)
        variance = np.square(out[:, 6:]) @ self._average
        spread = np.sqrt((variance * np.exp(-2.0 * log_factor)).max(axis=1))
        agreed = np.minimum(np.maximum((SPREAD[1] - spread) / (SPREAD[1] - SPREAD[0]), 0.0), 1.0)
        trusted = self._trust * agreed
        return Correction(shift * trusted[:, None], log_factor * trusted[:, None], trusted)

    def _remembering(self, front: Array32) -> Array32:
        """Compute the next state (n, units) of the gated recurrent unit (Cho et al. 2014)."""
        hidden, units = self._hidden, self._hidden.shape[1]
        (weight, bias), (past, past_bias) = self._gates
        gates = 1.0 / (1.0 + np.exp(-(front @ weight + hidden @ past + (bias + past_bias))))
        reset, update = gates[:, :units], gates[:, units:]
        (weight, bias), (past, past_bias) = self._candidate
        candidate = np.tanh((hidden @ past + past_bias) * reset + front @ weight + bias)
        state: Array32 = (hidden - candidate) * update + candidate
        return state


def _mean_and_differences(weight: Array32, bias: Array32) -> tuple[Array32, Array32]:
    """Return the weight and bias of a layer that combines the outputs of an ensemble's members.

    The layer's outputs are the members' mean, then each member's shift minus the mean shift.
    """
    members = np.concatenate([weight, bias[None]]).reshape(len(weight) + 1, -1, CORRECTIONS)
    mean = members.mean(axis=1)
    differences = (members - mean[:, None])[..., :3]
    rows = np.concatenate([mean, differences.reshape(len(mean), -1)], axis=1)
    return rows[:-1], rows[-1]


def learned_policy(path: AnyPath) -> LearnedSwitch | Corrector:
    """Return the switcher or the corrector in a policy file, given by its path or shipped name."""
    return Corrector(path) if LearnedPolicy(path).card.base else LearnedSwitch(path)
