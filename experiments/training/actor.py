"""Conversion of a PyTorch policy's actor to the tensors of a policy file."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.numerics.numbers import Array
from policies.policy_file import Tensors


class Normalization(NamedTuple):
    """Normalization of an observation o in training: (clip(o, low, high) - mean) / sigma."""

    low: Array  # (features,), the shape of all four
    high: Array
    mean: Array
    sigma: Array


def actor_tensors(policy: Any, normal: Normalization) -> Tensors:
    """Return an actor's tensors, with the normalization of observations in its first weights.

    Args:
        policy: policy of an actor-critic algorithm of Stable-Baselines3.
        normal: normalization of an observation.
    """
    tensors = layer_tensors([*policy.mlp_extractor.policy_net, policy.action_net])
    return folded(tensors, normal)


def layer_tensors(layers: Iterable[Any]) -> dict[str, Array]:
    """Return weights and biases of the linear layers under the names of a policy file."""
    linear = [layer for layer in layers if type(layer).__name__ == "Linear"]
    tensors: dict[str, Array] = {}
    for i, layer in enumerate(linear):
        tensors[f"layer.{i}.weight"] = _array(layer.weight)
        tensors[f"layer.{i}.bias"] = _array(layer.bias)
    return tensors


def folded(tensors: dict[str, Array], normal: Normalization) -> Tensors:
    """Fold the normalization into the first weights: W / sigma, b - (W / sigma) mean.

    Args:
        tensors: tensors of an actor on normalized observations.
        normal: normalization of an observation; the result includes its bounds.
    """
    first, bias = "layer.0.weight", "layer.0.bias"
    weight = tensors[first] / normal.sigma
    moved = {
        "low": normal.low,
        "high": normal.high,
        first: weight,
        bias: tensors[bias] - weight @ normal.mean,
    }
    return {name: tensor.astype(np.float32) for name, tensor in (tensors | moved).items()}


def require_actor(policy: Any) -> None:
    """Refuse a network that a policy file can't hold.

    Raises:
        ValueError: says what was found in the network and what was expected.
    """
    if not hasattr(policy, "action_net"):
        raise ValueError(
            f"network: found {type(policy).__name__}, expected an actor beside a critic, as of "
            "PPO, A2C, TRPO and MaskablePPO"
        )
    layers = [type(layer).__name__ for layer in policy.mlp_extractor.policy_net]
    for what, found, expected in (
        ("observations", policy.observation_space.shape, policy.observation_space.shape[:1]),
        ("extractor of features", type(policy.features_extractor).__name__, "FlattenExtractor"),
        ("layers of the actor", ", ".join(layers),
         ", ".join(["Linear", "Tanh"] * (len(layers) // 2))),
        ("output", type(policy.action_net).__name__, "Linear"),
        ("actions", type(policy.action_space).__name__, "Discrete"),
    ):  # fmt: skip
        if found != expected:
            raise ValueError(f"{what}: found {found}, expected {expected}")


def _array(parameter: Any) -> Array:
    array: Array = parameter.detach().numpy().astype(np.float64)
    return array
