"""Conversion of a PyTorch policy's actor (the network that acts) to tensors of a policy file."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.numerics.numbers import Array
from policies.policy_file import Tensors


class Normalization(NamedTuple):
    """Normalization of an observation o in training: (clip(o, low, high) - mean) / sigma."""

    low: Array  # all four arrays are (features,)
    high: Array
    mean: Array
    sigma: Array

    @classmethod
    def clipped(cls, mean: Array, sigma: Array, clip: float) -> "Normalization":
        """Return the normalization that clips at ``clip`` standard deviations from the mean."""
        return cls(mean - clip * sigma, mean + clip * sigma, mean, sigma)


def layers_of(policy: Any) -> list[Any]:
    """Return the layers of the actor in a policy of Stable-Baselines3."""
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def actor_tensors(layers: Iterable[Any], normal: Normalization) -> Tensors:
    """Return the tensors of an actor in the form that a policy file stores.

    The normalization's mean and sigma are folded into the first linear layer: its weights W become
    W / sigma, and its biases b become b - (W / sigma) mean.

    Args:
        layers: layers of a network for normalized observations; only linear layers have tensors.
        normal: normalization of an observation; its ``low`` and ``high`` become tensors, too.
    """
    tensors = {"low": normal.low, "high": normal.high}
    for i, layer in enumerate(layer for layer in layers if type(layer).__name__ == "Linear"):
        weight = layer.weight.detach().numpy().astype(np.float64)
        bias = layer.bias.detach().numpy().astype(np.float64)
        if not i:
            weight = weight / normal.sigma
            bias = bias - weight @ normal.mean
        tensors |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
    return {name: tensor.astype(np.float32) for name, tensor in tensors.items()}


def require_actor(file: str, policy: Any) -> None:
    """Refuse a network that a policy file can't hold.

    Raises:
        ValueError: the network is not a tanh network with discrete actions. The message names the
            file, what was found in it, and what was expected.
    """
    if not hasattr(policy, "action_net"):
        raise ValueError(
            f"{file}: network: found {type(policy).__name__}, expected an actor and a critic, "
            "as in PPO, A2C, TRPO and MaskablePPO"
        )
    layers = layers_of(policy)
    shape = policy.observation_space.shape
    parts = [policy.features_extractor, *layers, policy.action_space]
    kinds = [type(part).__name__ for part in parts]
    hidden = ["Linear", "Tanh"] * (len(layers) // 2)
    expected = ["FlattenExtractor", *hidden, "Linear", "Discrete"]
    if kinds != expected or len(shape) != 1:
        raise ValueError(
            f"{file}: network: found {', '.join(kinds)} for observations {shape}, expected "
            f"{', '.join(expected)} for observations (features,)"
        )
