"""Learned policies, which were trained with PyTorch and run compiled."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from mmwave_env.compiler.program import Repeated
from mmwave_env.filters.bank import Bank
from mmwave_env.interface.features import UNSEEN
from mmwave_env.interface.observation import Column, Observation
from mmwave_env.interface.policy import Policy
from mmwave_env.io.files import AnyPath
from mmwave_env.io.lookup import unknown
from mmwave_env.models.radio import radio_from
from mmwave_env.numerics.numbers import Array32, Index
from policies.network import Sight, layer_in, weigh_epoch
from policies.policy_file import PolicyFile, read_policy


def shipped_policies() -> dict[str, Path]:
    """Return the policy files of the package, by name."""
    folder = Path(__file__).with_name("data")
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


class LearnedPolicy:
    """A policy file and the environment's features that its network reads.

    Args:
        path: a policy file (``.safetensors``) or its content, or the name of a shipped policy.
        observation: the environment's table of features, in which the policy looks up its features
            by name; None if observations have exactly the features listed in the policy's file.

    Attributes:
        card: description of the policy's training.
        modes: modes that the environment must have; if every mode has its own belief, these are
            the modes of the first bank in the file.
        beliefs: beliefs that the environment must have, "shared" or "per-mode".
        observation: kind of observation that the environment must have.
        sight: how the network reads observations.

    Raises:
        ValueError: the name is unknown, the file is damaged, or the environment lacks a feature.
        FileNotFoundError: the file does not exist.
    """

    def __init__(self, path: AnyPath | PolicyFile, observation: Observation | None = None) -> None:
        self._file = policy_file(path)
        self.card = self._file.card
        self.modes = self.card.modes
        self.observation = self.card.observation
        self.beliefs = self.card.beliefs
        if observation is None:
            self._find_in(self.card.features)
        else:
            self.read_from(observation)

    def bank(self, radio: str = "handset") -> Bank:
        """Return the bank (set of modes) for a radio, if the policy needs a belief per mode.

        Args:
            radio: name or file of the radio profile. If the policy has no bank for the profile, the
                result is the bank for its base profile, else for "standard", else the first bank.

        Raises:
            ValueError: the policy was trained with a shared belief.
        """
        banks = self.card.banks
        if not banks:
            raise ValueError(
                f"{self._file.path}: found no banks, because the policy was trained with "
                "beliefs='shared'; use policy.modes"
            )
        if radio in banks:
            return banks[radio]
        profile = radio_from(radio)
        known = (profile.name, profile.base, "standard", next(iter(banks)))
        return next(banks[name] for name in known if name in banks)

    def read_from(self, observation: Observation) -> None:
        """Find the policy's features, by name, in the observations of an environment.

        Features that the policy does not know are ignored. In a scene with more anchors than in
        training, the policy uses the first anchors; with fewer, it treats the missing anchors as
        never visible (:data:`~mmwave_env.interface.features.UNSEEN`).

        Raises:
            ValueError: the environment lacks the beliefs or modes of the training, or a feature is
                missing or has another unit or scale; the message names the mismatch and a remedy.
        """
        card = self.card
        banks = [card.modes, *(bank.modes for bank in card.banks.values())]
        if observation.beliefs != card.beliefs or observation.modes not in banks:
            raise ValueError(
                f"{self._file.path}: trained with beliefs={card.beliefs!r} and the modes "
                f"{', '.join(mode.name for mode in card.modes)}, found {observation.made_with} (if "
                "the names agree, the tuning differs); make the environment as in training: "
                f"{self._made_with}"
            )
        self._find_in(observation.columns)

    def _find_in(self, columns: Sequence[Column]) -> None:
        """Find the policy's features, by name, in the columns of an environment's observations."""
        features = self.card.features
        names = [column.name for column in columns]
        anchors = {name.rpartition(" anchor ")[2] for name in names if " SNR anchor " in f" {name}"}
        unseen = np.full(len(features), np.nan, np.float32)
        read = np.zeros(len(features), np.int64)
        for i, feature in enumerate(features):
            kind, anchor, rest = feature.name.partition(" anchor ")
            if anchor and kind != "distance" and rest.split()[0] not in anchors:
                unseen[i] = (UNSEEN.get(kind, 0.0) - feature.mean) / feature.deviation
            elif feature in columns:
                read[i] = columns.index(feature)
            else:
                values = "none (fewer anchors, or a known height?)"
                if feature.name in names:
                    values = f"{columns[names.index(feature.name)][1:]}"
                raise ValueError(
                    f"{self._file.path}: feature {feature.name!r}: found {values}, expected unit, "
                    f"mean and deviation {feature[1:]}; make the environment as in training: "
                    f"{self._made_with}"
                )
        self._width = len(columns)
        tensors = self._file.tensors
        self.sight = Sight(read, unseen, tensors["low"], tensors["high"])

    @property
    def _made_with(self) -> str:
        """Return Python code that makes an environment for this policy."""
        arguments = "modes=policy.modes"
        if self.card.banks:
            arguments = f'beliefs="per-mode", modes=policy.bank("{next(iter(self.card.banks))}")'
        return f'gym.make("MmWaveLoc-v0", {arguments}, observation={self.card.observation!r})'

    def _checked(self, observation: Array32) -> Array32:
        """Return observations (n, columns) for compiled code.

        Raises:
            ValueError: the number of columns is wrong.
        """
        if observation.ndim != 2 or observation.shape[1] != self._width:
            raise ValueError(
                f"observation: found shape {observation.shape}, expected (n, {self._width}); for a "
                "single environment pass observation[None]; if an observation has more features "
                f"than those of {self._made_with}, use "
                f"{type(self).__name__}({str(self._file.path)!r}, env.unwrapped.observation)"
            )
        return np.ascontiguousarray(observation, np.float32)


class LearnedSwitch(LearnedPolicy, Policy):
    """A policy whose network chooses the mode to run or, with a belief per mode, the mode to trust.

    ```python
    >>> policy = LearnedSwitch("runs/mine.safetensors")
    >>> env = gym.make("mmwave_env:MmWaveLoc-v0", modes=policy.modes)
    >>> observation, info = env.reset(seed=0)
    >>> policy.reset(np.array([True]))
    >>> (action,) = policy.act(observation[None])

    ```

    With a belief per mode, make the environment with the policy's bank for the radio:

    ```python
    >>> policy = LearnedSwitch("runs/per-mode.safetensors")
    >>> env = gym.make(
    ...     "mmwave_env:MmWaveLoc-v0", beliefs=policy.beliefs, modes=policy.bank("handset")
    ... )

    ```

    Arguments, attributes and errors: same as for :class:`LearnedPolicy`.
    """

    def __init__(self, path: AnyPath | PolicyFile, observation: Observation | None = None) -> None:
        super().__init__(path, observation)
        if self.card.base:
            raise ValueError(
                f"{self._file.path}: found a corrector, expected a switcher; use policies.Corrector"
            )
        tensors = self._file.tensors
        count = sum(name.startswith("layer.") for name in tensors) // 2
        self.layers = tuple(layer_in(tensors, f"layer.{i}") for i in range(count))
        self._run = Repeated(weigh_epoch)

    def act(self, observation: Array32) -> Index:
        """Return actions (n,) for observations (n, features); errors as in :meth:`logits`."""
        actions: Index = self.logits(observation).argmax(axis=1)
        return actions

    def logits(self, observation: Array32) -> Array32:
        """Compute logits (n, actions): logarithms of probabilities, up to a constant per row.

        Args:
            observation: (n, features) observations.

        Raises:
            ValueError: the number of features is wrong.
        """
        observations = self._checked(observation)
        n = len(observations)
        logits = np.empty((n, len(self.layers[-1].bias)), np.float32)
        self._run([(0, n)], 1, observations, self.sight, self.layers, logits)
        return logits


def policy_file(path: AnyPath | PolicyFile) -> PolicyFile:
    """Return the content of a policy file, given by its path or as the name of a shipped policy."""
    if isinstance(path, PolicyFile):
        return path
    if not isinstance(path, str) or path.endswith(".safetensors"):
        return read_policy(path)
    shipped = shipped_policies()
    if path not in shipped:
        raise ValueError(unknown("policy", path, [*shipped, "a .safetensors file"]))
    return _read_once(shipped[path])


_read_once = cache(read_policy)  # of shipped files, which do not change
