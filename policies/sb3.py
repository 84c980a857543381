"""Policy files of models that were trained with Stable-Baselines3."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.io.files import AnyPath, atomic_path
from mmwave_env.numerics.numbers import Array, Array32
from policies.learned import LearnedSwitch
from policies.policy_file import Card, Tensors, to_bytes, versions_of

DECISIONS = 1000  # number of random observations for which the model and the file are compared
TIES = 0.001  # maximum fraction of observations on which rounding may change the action


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

    def normalized(self, observations: NDArray[Any]) -> Array32:
        """Return observations (..., features) as the network reads them in training."""
        inside = np.clip(observations, self.low.astype(np.float32), self.high.astype(np.float32))
        return (inside - self.mean.astype(np.float32)) / self.sigma.astype(np.float32)  # type: ignore[no-any-return]

    def folded(self, weight: Array, bias: Array) -> tuple[Array, Array]:
        """Return weight (out, features) and bias (out,) of a layer for observations as they are.

        The weight W and the bias b, for normalized observations, become W / sigma and
        b - (W / sigma) mean.
        """
        weight = weight / self.sigma
        return weight, bias - weight @ self.mean

    @classmethod
    def of(cls, model: Any) -> "Normalization":
        """Return the normalization of a model's ``VecNormalize``, or the identity without one."""
        normal = model.get_vec_normalize_env()
        if normal is None or not normal.norm_obs:
            space = model.observation_space
            low = space.low.astype(float)
            high = space.high.astype(float)
            return cls(low, high, np.zeros(space.shape), np.ones(space.shape))
        moments = normal.obs_rms
        sigma = np.sqrt(moments.var + normal.epsilon)
        return cls.clipped(moments.mean, sigma, normal.clip_obs)


def actor_tensors(layers: Iterable[Any], normal: Normalization) -> Tensors:
    """Return the tensors of an actor in the form that a policy file stores.

    The normalization's mean and sigma are folded into the first linear layer.

    Args:
        layers: layers of a network for normalized observations; only linear layers have tensors.
        normal: normalization of an observation; its ``low`` and ``high`` become tensors, too.
    """
    tensors = {"low": normal.low, "high": normal.high}
    linear = [layer for layer in layers if type(layer).__name__ == "Linear"]
    for i, layer in enumerate(linear):
        ends = [part.detach().cpu().double().numpy() for part in (layer.weight, layer.bias)]
        weight, bias = ends if i else normal.folded(*ends)
        tensors |= {f"layer.{i}.weight": weight, f"layer.{i}.bias": bias}
    return {name: tensor.astype(np.float32) for name, tensor in tensors.items()}


def model_tensors(model: Any) -> Tensors:
    """Return the tensors of a Stable-Baselines3 model's actor, for a policy file."""
    layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    return actor_tensors(layers, Normalization.of(model))


def save_sb3(model: Any, path: AnyPath) -> None:
    """Write a trained Stable-Baselines3 model to a policy file, which plays without PyTorch.

    Modes, beliefs and features are those of the model's environment. If the environment is wrapped
    in ``VecNormalize``, its normalization becomes part of the network. The file contains numbers
    and no code.

    ```python
    >>> model = PPO("MlpPolicy", VecNormalize(SB3VecEnv(envs)))
    >>> model.learn(total_timesteps=200_000)
    >>> save_sb3(model, "policy.safetensors")

    ```

    Args:
        model: a PPO, A2C, TRPO or MaskablePPO with an ``MlpPolicy`` of tanh layers and discrete
            actions. A model that was loaded from a file needs its environment:
            ``PPO.load("model.zip", env=envs)``.
        path: file to write (``.safetensors``).

    Raises:
        ValueError: the path has another ending, the model has no environment or another kind of
            network, or the layers alone choose other actions than the model.
        OSError: the file can't be written.
    """
    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"path: found {path}, expected a name that ends with .safetensors")
    if model.get_env() is None:
        raise ValueError(
            "model: found no environment, expected one, as in PPO.load('model.zip', env=envs)"
        )
    discrete = type(model.action_space).__name__ == "Discrete"
    if not (discrete and hasattr(model.policy, "action_net")):
        raise ValueError(
            f"model: found {type(model.policy).__name__} and {model.action_space}, expected an "
            "actor and a critic with discrete actions, as in PPO, A2C, TRPO and MaskablePPO"
        )
    content = to_bytes(model_tensors(model), _card(model))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
        _require_same_actions(model, LearnedSwitch(temporary))


def _card(model: Any) -> Card:
    """Describe a model's training and environment."""
    table = _attribute(model, "observation")
    radio = _attribute(model, "radio")
    bank = _attribute(model, "bank")
    return Card(
        modes=table.modes,
        observation=table.kind,
        features=table.columns,
        scenario=_attribute(model, "source").name,
        radio=radio.name,
        algorithm=type(model).__name__,
        seed=-1 if model.seed is None else model.seed,
        timesteps=model.num_timesteps,
        command="policies.save_sb3",
        evaluation={},
        versions=versions_of("gymnasium", "numpy", "torch", "stable-baselines3"),
        beliefs=table.beliefs,
        banks={radio.name: bank} if bank else {},
    )


def _attribute(model: Any, name: str) -> Any:
    """Return an attribute of the first of a model's environments, which are alike."""
    return model.get_env().get_attr(name, 0)[0]


def _require_same_actions(model: Any, policy: LearnedSwitch) -> None:
    """Refuse a file that, on random observations, chooses other actions than its model."""
    normal = Normalization.of(model)
    spread = np.random.default_rng(0).uniform(-2.0, 2.0, (DECISIONS, len(normal.mean)))
    observations = (normal.mean + normal.sigma * spread).astype(np.float32)
    chosen, _ = model.predict(normal.normalized(observations), deterministic=True)
    alike = policy.act(observations) == chosen
    if alike.mean() < 1.0 - TIES:
        raise ValueError(
            "model: its layers alone choose the same action as the model for "
            f"{alike.sum()} of {alike.size} observations, expected all; the model does more than "
            "apply linear layers with tanh between them"
        )
