"""Actor and critic, and what of them a policy file takes over."""

from typing import Any, cast

import numpy as np
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import Tensor, nn, no_grad

from experiments.training.actor import Normalization, actor_tensors
from experiments.training.fast_ppo import FastPPO
from experiments.training.hyperparameters import Hyperparameters, falling
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


def learner(
    world: TrainingEnv, recipe: Hyperparameters, seed: int, fast: bool = True
) -> OnPolicyAlgorithm:
    """The algorithm of a recipe, ready to learn in a world.

    A network with a memory learns by Stable-Baselines3's own loop, any other by ours.

    Args:
        world: to learn in; it is seeded, too.
        recipe: hyperparameters.
        seed: of everything that is drawn.
        fast: False for Stable-Baselines3's own loop in any case.
    """
    what: dict[str, Any] = {
        "n_steps": recipe.n_steps, "batch_size": recipe.batch_size, "n_epochs": recipe.n_epochs,
        "learning_rate": lambda left: recipe.learning_rate * falling(recipe.final_fraction, left),
        "ent_coef": recipe.ent_coef, "gamma": recipe.gamma, "gae_lambda": recipe.gae_lambda,
        "clip_range": recipe.clip_range, "max_grad_norm": recipe.max_grad_norm,
        "target_kl": recipe.target_kl, "seed": seed, "device": "cpu",
    }  # fmt: skip
    if recipe.lstm:
        shape = {
            "lstm_hidden_size": recipe.lstm, "activation_fn": nn.Tanh,
            "net_arch": {"pi": list(recipe.hidden), "vf": list(recipe.hidden)},
        }  # fmt: skip
        model: OnPolicyAlgorithm = RecurrentPPO(
            "MlpLstmPolicy", world.venv, policy_kwargs=shape, **what
        )
    else:
        views = {"actor": world.features * recipe.frames, "hidden": recipe.hidden}
        shape = {**views, "optimizer_kwargs": {"eps": 1e-5, "fused": fast}}  # eps is its default
        model = (
            FastPPO(_Policy, world.venv, world=world, policy_kwargs=shape, **what)
            if fast
            else PPO(_Policy, world.venv, policy_kwargs=shape, **what)
        )
    with no_grad():
        cast(nn.Linear, model.policy.action_net).bias[0] += recipe.first_action_bias
    return model


def actor_of(model: OnPolicyAlgorithm, world: TrainingEnv, recipe: Hyperparameters) -> Tensors:
    """The actor of a training as a policy file holds it; observations are clipped at c sigma."""
    seen, features = world.seen, world.features
    mean, sigma = seen.mean[:features], np.sqrt(seen.var[:features] + world.normal.epsilon)
    limit = recipe.clip_observation * sigma
    normal = Normalization(mean - limit, mean + limit, mean, sigma)
    return actor_tensors(model.policy, normal, recipe.frames)
