"""Actor and critic, and what of them a policy file takes over."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor, nn

from experiments.training.hyperparameters import Hyperparameters
from experiments.training.training_env import TrainingEnv
from policies.policy_file import Tensors


class _Views(nn.Module):
    """Two tanh networks; the actor's sees the first features alone.

    Args:
        actor, critic: how many features each sees.
        hidden: neurons of each layer.
    """

    def __init__(self, actor: int, critic: int, hidden: tuple[int, ...]) -> None:
        super().__init__()
        self.policy_net, self.value_net = _tanh(actor, hidden), _tanh(critic, hidden)
        self.latent_dim_pi = self.latent_dim_vf = hidden[-1]
        self._actor = actor

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: Tensor) -> Tensor:
        latent: Tensor = self.policy_net(features[:, : self._actor])
        return latent

    def forward_critic(self, features: Tensor) -> Tensor:
        latent: Tensor = self.value_net(features)
        return latent


def _tanh(inputs: int, hidden: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for neurons in hidden:
        layers += [nn.Linear(inputs, neurons), nn.Tanh()]
        inputs = neurons
    return nn.Sequential(*layers)


class _Policy(ActorCriticPolicy):
    """Actor and critic with views of their own.

    Args:
        actor: how many features the actor sees; the critic sees all.
        hidden: neurons of each layer.
    """

    def __init__(self, *args: Any, actor: int, hidden: tuple[int, ...], **kwargs: Any) -> None:
        self._actor, self._hidden = actor, hidden
        super().__init__(*args, **kwargs)

    def _build_mlp_extractor(self) -> None:
        views = _Views(self._actor, self.features_dim, self._hidden)
        self.mlp_extractor = cast(MlpExtractor, views)  # which has the same methods


def learner(world: TrainingEnv, recipe: Hyperparameters, seed: int) -> OnPolicyAlgorithm:
    """The algorithm of a recipe, ready to learn in a world.

    Args:
        world: to learn in; it is seeded, too.
        recipe: hyperparameters.
        seed: of everything that is drawn.
    """
    what: dict[str, Any] = {
        "n_steps": recipe.n_steps, "batch_size": recipe.batch_size, "n_epochs": recipe.n_epochs,
        "learning_rate": lambda left: recipe.learning_rate * falling(recipe, left),
        "ent_coef": recipe.ent_coef, "gamma": recipe.gamma, "gae_lambda": recipe.gae_lambda,
        "clip_range": recipe.clip_range, "max_grad_norm": recipe.max_grad_norm,
        "target_kl": recipe.target_kl, "seed": seed, "device": "cpu",
    }  # fmt: skip
    if recipe.lstm:
        shape = {
            "lstm_hidden_size": recipe.lstm, "activation_fn": nn.Tanh,
            "net_arch": {"pi": list(recipe.hidden), "vf": list(recipe.hidden)},
        }  # fmt: skip
        return RecurrentPPO("MlpLstmPolicy", world.venv, policy_kwargs=shape, **what)
    seen = world.features * recipe.frames
    return PPO(_Policy, world.venv, policy_kwargs={"actor": seen, "hidden": recipe.hidden}, **what)


def falling(recipe: Hyperparameters, left: float) -> float:
    """What remains of a rate when a fraction of the training is left."""
    return recipe.final_fraction + (1.0 - recipe.final_fraction) * left


def actor_of(model: OnPolicyAlgorithm, world: TrainingEnv, recipe: Hyperparameters) -> Tensors:
    """The actor as a policy file holds it, with the normalization in its first weights.

    Training sees clip((o - mean) / sigma, -c, c). The file has the bounds mean -+ c sigma, and
    weights W / sigma with bias b - W mean / sigma.
    """
    policy, seen = model.policy, world.seen
    mean = np.tile(seen.mean[: world.features], recipe.frames)
    sigma = np.sqrt(seen.var[: world.features] + world.normal.epsilon)
    limit = recipe.clip_observation * sigma
    one = seen.mean[: world.features]
    tensors = {"low": one - limit, "high": one + limit}
    linear = [m for m in policy.mlp_extractor.policy_net if isinstance(m, nn.Linear)]
    for i, layer in enumerate([*linear, policy.action_net]):
        tensors[f"layer.{i}.weight"] = _array(layer.weight)
        tensors[f"layer.{i}.bias"] = _array(layer.bias)
    first, bias = "layer.0.weight", "layer.0.bias"
    if recipe.lstm:
        first, bias = "lstm.weight_ih", "lstm.bias"
        lstm = cast(nn.LSTM, policy.lstm_actor)
        tensors |= {
            first: _array(lstm.weight_ih_l0), "lstm.weight_hh": _array(lstm.weight_hh_l0),
            bias: _array(lstm.bias_ih_l0) + _array(lstm.bias_hh_l0),
        }  # fmt: skip
    tensors[first] = tensors[first] / np.tile(sigma, recipe.frames)
    tensors[bias] = tensors[bias] - tensors[first] @ mean
    return {name: tensor.astype(np.float32) for name, tensor in tensors.items()}


def _array(parameter: Tensor | nn.Module) -> NDArray[np.float64]:
    """A parameter; PyTorch types every attribute of a network as one or the other."""
    array: NDArray[np.float64] = cast(Tensor, parameter).detach().numpy().astype(np.float64)
    return array
