"""Learned switchers, trained with PyTorch, and run with numpy."""

import os
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mmwave_env import __version__
from mmwave_env.filters.bank import Bank
from mmwave_env.lookup import unknown
from mmwave_env.models.radio import radio_from
from mmwave_env.observation import Observation
from policies.policy_file import Tensors, read_policy

Array = NDArray[np.float32]


def shipped_policies() -> dict[str, Path]:
    """Return the policy files of the package, by name."""
    folder = Path(str(files("policies").joinpath("data")))
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


class LearnedSwitch:
    """A network that chooses the mode, or the mode to trust, by the most probable action.

    ```python
    >>> policy = LearnedSwitch("runs/mine.safetensors")
    >>> env = gym.make("mmwave_env:MmWaveLoc-v0", modes=policy.modes)
    >>> observation, info = env.reset(seed=0)
    >>> policy.reset(np.array([True]))
    >>> (action,) = policy(observation[None])

    ```

    With a belief per mode, the environment takes the policy's bank for its radio:

    ```python
    >>> policy = LearnedSwitch("runs/per-mode.safetensors")
    >>> env = gym.make(
    ...     "mmwave_env:MmWaveLoc-v0", beliefs=policy.beliefs, modes=policy.bank("handset")
    ... )

    ```

    Args:
        path: a policy file (``.safetensors``), or the name of a shipped policy.
        observation: the environment's table of features, to check that the policy was trained
            with the same table.

    Attributes:
        card: description of the policy's training.
        modes: modes of its environments; with a belief per mode, the modes of the first bank.
        beliefs: "shared" or "per-mode", as in its environments.

    Raises:
        ValueError: the name is unknown, the file is damaged, or the table of features differs.
        FileNotFoundError: there is no such file.
    """

    def __init__(
        self, path: str | os.PathLike[str], observation: Observation | None = None
    ) -> None:
        self._path = _located(path)
        tensors, self.card = read_policy(self._path)
        self.modes, self.beliefs = self.card.modes, self.card.beliefs
        self._low, self._high = tensors["low"], tensors["high"]
        self._memory = _Lstm(tensors) if "lstm.bias" in tensors else None
        layers = sum(name.startswith("layer.") for name in tensors) // 2
        self._layers = [
            (tensors[f"layer.{i}.weight"].T, tensors[f"layer.{i}.bias"]) for i in range(layers)
        ]
        self._begins = np.empty(0, bool)
        if observation is not None:
            self.require_trained_on(observation)

    def bank(self, radio: str = "handset") -> Bank:
        """Return the bank to use with a radio, for a policy with a belief per mode.

        Args:
            radio: name or file of the profile; a profile unknown in training gets the bank of its
                base, of "standard", or the first bank, if these are missing.

        Raises:
            ValueError: the policy was trained with a shared belief.
        """
        banks = self.card.banks
        if not banks:
            raise ValueError(
                f"{self._path}: found no banks, as it was trained with beliefs='shared'; use "
                "policy.modes"
            )
        if radio in banks:
            return banks[radio]
        profile, first = radio_from(radio), next(iter(banks))
        known = (profile.name, profile.base, "standard", first)
        return next(banks[name] for name in known if name in banks)

    def require_trained_on(self, observation: Observation) -> None:
        """Refuse an environment with other observations or actions than in training.

        Raises:
            ValueError: the environment differs; the message says how, and what to do.
        """
        card, found = self.card, observation
        trained = f"{self._path}: trained with"
        alike = (found.beliefs, found.kind) == (card.beliefs, card.observation)
        if not alike or found.modes not in [card.modes, *(b.modes for b in card.banks.values())]:
            names = ", ".join(mode.name for mode in card.modes)
            raise ValueError(
                f"{trained} observation={card.observation!r}, beliefs={card.beliefs!r} and the "
                f"modes {names}, found {found.made_with}, or another tuning of them; make the "
                f"environment as in training: {self._made_with}"
            )
        if found.digest != card.digest:
            raise ValueError(
                f"{trained} {len(self._low)} features ({card.digest}) of mmwave-loc "
                f"{card.versions['mmwave-loc']}, found {len(found)} ({found.digest}) of "
                f"{__version__}; give the environment as many anchors and the odometry it was "
                "trained with, or train it again with this version"
            )

    @property
    def _made_with(self) -> str:
        """Return the code that makes an environment for this policy."""
        arguments = "modes=policy.modes"
        if self.card.banks:
            arguments = f'beliefs="per-mode", modes=policy.bank("{next(iter(self.card.banks))}")'
        return f'gym.make("MmWaveLoc-v0", {arguments}, observation={self.card.observation!r})'

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Forget the past of the environments (n,) in which an episode begins.

        Raises:
            ValueError: there are more or fewer environments than before, and not all begin.
        """
        if len(mask) == len(self._begins):
            self._begins |= mask
        elif mask.all():
            self._begins = np.ones(len(mask), bool)
        else:
            raise ValueError(
                f"reset: found {len(mask)} environments, expected {len(self._begins)}, or that "
                "all of them begin"
            )

    def __call__(self, observation: Array) -> NDArray[np.int64]:
        """Return actions (n,) for observations (n, features); :meth:`logits` raises the errors."""
        actions: NDArray[np.int64] = self.logits(observation).argmax(axis=1)
        return actions

    def logits(self, observation: Array) -> Array:
        """Compute logarithms of the actions' probabilities (n, actions), up to a constant per row.

        A policy with a memory updates it with the observations, as a call does.

        Args:
            observation: (n, features) observations.

        Raises:
            ValueError: the number of features differs, or, for a policy with a memory, the
                number of environments differs from the last reset.
        """
        if observation.ndim != 2 or observation.shape[1] != len(self._low):
            raise ValueError(
                f"observation: found shape {observation.shape}, expected (n, {len(self._low)}); "
                "of a single environment take observation[None], and make it as in training: "
                f"{self._made_with}"
            )
        x = np.minimum(np.maximum(observation, self._low), self._high)
        if self._memory is not None:
            if len(x) != len(self._begins):
                raise ValueError(
                    f"observation: found {len(x)} environments, expected {len(self._begins)}; "
                    "call policy.reset(np.ones(n, bool)) when n episodes begin"
                )
            x = self._memory(x, self._begins)
            self._begins[:] = False
        *hidden, (weight, bias) = self._layers
        for w, b in hidden:
            x = x @ w
            x += b
            np.tanh(x, out=x)
        found: Array = x @ weight + bias
        return found


def _located(path: str | os.PathLike[str]) -> Path:
    """Return the path of a policy file, given as a path or as the name of a shipped policy."""
    if not isinstance(path, str) or path.endswith(".safetensors"):
        return Path(path)
    shipped = shipped_policies()
    if path not in shipped:
        raise ValueError(unknown("policy", path, [*shipped, "a .safetensors file"]))
    return shipped[path]


class _Lstm:
    """A long short-term memory (Hochreiter and Schmidhuber 1997), as PyTorch writes it.

    c' = sigmoid(f) c + sigmoid(i) tanh(g), h' = sigmoid(o) tanh(c'), where the gates i, f, g, o
    are the quarters of W_ih x + W_hh h + b.
    """

    def __init__(self, tensors: Tensors) -> None:
        self._from_input, self._from_h = tensors["lstm.weight_ih"].T, tensors["lstm.weight_hh"].T
        self._bias = tensors["lstm.bias"]
        self._h = self._c = np.empty((0, len(self._from_h)), np.float32)

    def __call__(self, x: Array, begins: NDArray[np.bool_]) -> Array:
        """Update the memory with inputs (n, in); return the new h (n, hidden)."""
        if len(self._h) != len(begins):
            self._h, self._c = np.zeros((2, len(begins), self._h.shape[1]), np.float32)
        self._h[begins] = self._c[begins] = 0.0
        gates = x @ self._from_input + self._h @ self._from_h + self._bias
        i, f, g, o = gates.reshape(len(gates), 4, -1).swapaxes(0, 1)
        self._c = _sigmoid(f) * self._c + _sigmoid(i) * np.tanh(g)
        self._h = _sigmoid(o) * np.tanh(self._c)
        return self._h


def _sigmoid(x: Array) -> Array:
    """Compute 1 / (1 + exp(-x)) in a form that does not overflow for any x."""
    result: Array = 0.5 * np.tanh(0.5 * x) + 0.5
    return result
