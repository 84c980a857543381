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
from mmwave_env.interface.observation import Observation, observation_columns
from mmwave_env.interface.policy import Correction, Policy, Switching
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import AnyPath
from mmwave_env.numerics.numbers import Array32, Index, Mask
from policies.learned import LearnedPolicy, LearnedSwitch, policy_file, taken
from policies.policy_file import CORRECTIONS, PolicyFile, Tensors

BASE_IMM = "imm-best"  # the name of the base if it is the IMM of the policy's bank
# file of the shipped two-way corrector, in a folder of its own because it is no policy
TWO_WAY = Path(str(files("policies").joinpath("data", "smoothing", "two-way.safetensors")))
# "Trust" is the factor, 0 to 1, by which corrections are scaled.
RANGE_FADE = 2.0  # trust is exp(-2 d) if a feature is d standard deviations outside its range
RECOVERY = 0.1  # maximum growth of trust per epoch; slow, as unusual features stay in the memory
# The network is an ensemble, whose members compute different shifts. If the spread of the shifts,
# in corrected standard deviations, is at most SPREAD[0], trust is not reduced; from SPREAD[1] on,
# trust is 0.
SPREAD = (0.5, 1.0)
AT_ONCE = 352  # maximum number of tracks in an array; more need new memory for every step
_MOST = np.array([MOST_SHIFT] * 3 + [MOST_LOG_FACTOR] * 3, np.float32)  # limits of an answer


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
        if ("back.bias_hh" in tensors) != ("back" in self.recurrent):
            wrong, right = ("filtered", "smoothed")[:: 1 if "back" in self.recurrent else -1]
            raise ValueError(
                f"{self._path}: found a corrector of {wrong} tracks, expected one of {right} tracks"
            )
        self._front = (tensors[f"{'front'}.weight"].T.copy(), tensors[f"{'front'}.bias"])
        self._head = (tensors[f"{'head'}.weight"].T.copy(), tensors[f"{'head'}.bias"])
        self._units = [_RecurrentUnit(tensors, name) for name in self.recurrent]
        self._out = _mean_and_differences(tensors["out.weight"].T, tensors["out.bias"])
        # matrix that averages squared differences over the ensemble's members, for each direction
        members = (self._out[0].shape[1] - CORRECTIONS) // 3
        self._average = np.tile(np.eye(3, dtype=np.float32), (members, 1)) / np.float32(members)

    def read_from_track(self, pipeline: Pipeline) -> None:
        """Find the policy's features among the features that tracks of a pipeline compute."""
        columns = observation_columns(after_update(pipeline, per_mode=True))
        self._of_track = self._found_in(columns)

    def _read(self, features: Array32) -> tuple[Array32, Array32]:
        """Return the first layer's output, and the trust that the features' ranges allow."""
        inside = np.fmin(np.fmax(features, self._low), self._high)  # NaN becomes the low limit
        beyond = np.abs(features - inside).max(axis=-1)
        weight, bias = self._front
        # Trust is 0 if a feature is NaN.
        return np.tanh(inside @ weight + bias), np.fmax(np.exp(-RANGE_FADE * beyond), 0.0)

    def _answer(self, memory: Array32, front: Array32, trust: Array32) -> Correction:
        """Return the corrections (..., 3), scaled by the trust (...,) and by the agreement."""
        weight, bias = self._head
        units = memory.shape[-1]
        head = np.tanh(memory @ weight[:units] + front @ weight[units:] + bias)
        weight, bias = self._out
        out = head @ weight + bias
        answer = np.minimum(np.maximum(out[..., :CORRECTIONS], -_MOST), _MOST)
        variance = np.square(out[..., CORRECTIONS:]) @ self._average
        spread = np.sqrt((variance * np.exp(-2.0 * answer[..., 3:])).max(axis=-1))
        agreed = np.minimum(np.maximum((SPREAD[1] - spread) / (SPREAD[1] - SPREAD[0]), 0.0), 1.0)
        trusted = trust * agreed
        answer *= trusted[..., None]
        return Correction(answer[..., :3], answer[..., 3:], trusted)


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

    corrects = True

    def __init__(self, path: AnyPath | PolicyFile, observation: Observation | None = None) -> None:
        super().__init__(path)
        base = self.card.base
        self._base = None if base == BASE_IMM else LearnedSwitch(base)
        self._hidden = np.zeros((0, self._units[0].size), np.float32)
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
        self._hidden[mask] = 0.0
        self._trust[mask] = 1.0
        if self._base:
            self._base.reset(mask)

    def act(self, observation: Array32) -> Index:
        """Return the base's actions (n,) for observations (n, features)."""
        if self._base is None:
            return np.zeros(len(observation), np.int64)
        return self._base.act(observation)

    def correct(self, observation: Array32) -> Correction:
        """Return corrections of the beliefs after the latest epoch; update the network's memory.

        Call this once after every step, with the observations (n, features) of the step.
        """
        return self.correct_features(self.features_in(observation))

    def correct_track(self, signed: Array32) -> Correction:
        """Return corrections of n tracks after an epoch, given their features (n, features)."""
        return self.correct_features(taken(signed.astype(np.float32), *self._of_track))

    def correct_features(self, features: Array32) -> Correction:
        """Return corrections, given the latest values of the network's features (n, features)."""
        first = range(0, max(len(features), 1), AT_ONCE)
        parts = [self._corrected(features, slice(i, i + AT_ONCE)) for i in first]
        return Correction(*map(np.concatenate, zip(*parts, strict=True)))

    def _corrected(self, features: Array32, rows: slice) -> Correction:
        """Update the memory of some rows, and return their corrections."""
        front, strange = self._read(features[rows])
        self._trust[rows] = trust = np.minimum(strange, self._trust[rows] + np.float32(RECOVERY))
        self._hidden[rows] = hidden = self._units[0](front, self._hidden[rows])
        return self._answer(hidden, front, trust)


class TwoWayCorrector(CorrectionNetwork):
    """A corrector of smoothed tracks, which reads each track forwards and backwards."""

    recurrent = ("gru", "back")

    def correct_tracks(self, features: Array32) -> Correction:
        """Return corrections (n, T, 3) of n smoothed tracks, given all their features.

        :func:`~mmwave_env.engines.smoothed_features.smoothed_features` computes the features
        (n, T, features); :meth:`read_from_track` must have been called for their pipeline.
        """
        n, epochs, width = features.shape
        read = taken(features.reshape(-1, width), *self._of_track).reshape(n, epochs, -1)
        front, strange = self._read(read)
        trust = strange.copy()
        memory = []
        for unit, order in zip(self._units, (range(epochs), range(epochs)[::-1]), strict=True):
            states = np.empty((n, epochs, unit.size), np.float32)
            state = np.zeros((n, unit.size), np.float32)
            so_far = np.ones(n, np.float32)
            for t in order:
                states[:, t] = state = unit(front[:, t], state)
                so_far = np.minimum(strange[:, t], so_far + np.float32(RECOVERY))
                trust[:, t] = np.minimum(trust[:, t], so_far)
            memory.append(states)
        return self._answer(np.concatenate(memory, axis=-1), front, trust)


class _RecurrentUnit:
    """A gated recurrent unit (Cho et al. 2014) with the tensors of a policy file."""

    def __init__(self, tensors: Tensors, name: str) -> None:
        self.size = units = len(tensors[f"{name}.bias_hh"]) // 3
        self._gates = _layers(tensors, name, slice(2 * units))
        self._candidate = _layers(tensors, name, slice(2 * units, None))

    def __call__(self, front: Array32, hidden: Array32) -> Array32:
        """Return the next state (n, units), given the input and the last state."""
        units = self.size
        (weight, bias), (past, past_bias) = self._gates
        gates = 1.0 / (1.0 + np.exp(-(front @ weight + hidden @ past + (bias + past_bias))))
        reset = gates[:, :units]
        update = gates[:, units:]
        (weight, bias), (past, past_bias) = self._candidate
        candidate = np.tanh((hidden @ past + past_bias) * reset + front @ weight + bias)
        state: Array32 = (hidden - candidate) * update + candidate
        return state


def _layers(tensors: Tensors, name: str, rows: slice) -> list[tuple[Array32, Array32]]:
    """Return some rows of a unit's weights (transposed) and biases: of its input, of its memory."""
    return [
        (tensors[f"{name}.weight_{end}"][rows].T.copy(), tensors[f"{name}.bias_{end}"][rows])
        for end in ("ih", "hh")
    ]


def _mean_and_differences(weight: Array32, bias: Array32) -> tuple[Array32, Array32]:
    """Return the weight and bias of a layer that combines the outputs of an ensemble's members.

    The layer's outputs are the members' mean, then each member's shift minus the mean shift.
    """
    members = np.concatenate([weight, bias[None]]).reshape(len(weight) + 1, -1, CORRECTIONS)
    mean = members.mean(axis=1)
    differences = (members - mean[:, None])[..., :3]
    rows = np.concatenate([mean, differences.reshape(len(mean), -1)], axis=1)
    return rows[:-1], rows[-1]


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
    make = partial(type(policy), file)
    return Switching(filters, None, make, file.card.observation, corrects=policy.corrects)
