"""Rollout policy iteration: a network learns from the values that rollouts find.

In every state of the memory all actions were tried, each followed by the policy of that time
(Bertsekas, Rollout, Policy Iteration, and Distributed Reinforcement Learning, 2020). The network
maximizes the mean of sum_a pi(a | s) (Q(s, a) - Q(s, 0)), with a small entropy bonus.
"""

from copy import deepcopy
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from experiments.training.actor import Normalization
from experiments.training.hyperparameters import RolloutHyperparameters
from experiments.training.rollout_env import Observations, Tried
from mmwave_env.numerics.numbers import Index


class RolloutLearner:
    """The network, its optimizer and the states that it learns from.

    Args:
        features, actions: numbers of features and of actions.
        hyper: hyperparameters.
        normal: normalization of an observation.
    """

    def __init__(
        self, features: int, actions: int, hyper: RolloutHyperparameters, normal: Normalization
    ) -> None:
        self._hyper = hyper
        self._low, self._high, self._mean, self._sigma = (
            torch.from_numpy(part.astype(np.float32)) for part in normal
        )
        layers: list[nn.Module] = []
        for width, neurons in pairwise((features, *hyper.hidden)):
            layers += [nn.Linear(width, neurons), nn.Tanh()]
        last = nn.Linear(hyper.hidden[-1], actions)
        with torch.no_grad():
            last.weight *= 0.1
            last.bias.zero_()
            last.bias[0] = hyper.first_action_bias
        self.network = nn.Sequential(*layers, last)
        self._optimizer = torch.optim.Adam(self.network.parameters(), lr=hyper.learning_rate)
        self._observations = torch.empty((hyper.memory, features))
        self._gains = torch.empty((hyper.memory, actions))
        self._seen = 0

    def _logits(self, observations: Observations) -> Tensor:
        logits: Tensor = self.network(self._normal(observations))
        return logits

    def _normal(self, observations: Observations) -> Tensor:
        clipped = torch.clamp(torch.from_numpy(observations), self._low, self._high)
        return (clipped - self._mean) / self._sigma

    @torch.no_grad()
    def greedy(self, observations: Observations) -> Index:
        """Return the most probable actions (n,) for observations (n, features)."""
        actions: Index = self._logits(observations).argmax(1).numpy()
        return actions

    @torch.no_grad()
    def sampled(self, observations: Observations) -> Index:
        """Draw actions (n,) by their probabilities, for observations (n, features)."""
        probabilities = torch.softmax(self._logits(observations), 1)
        actions: Index = torch.multinomial(probabilities, 1)[:, 0].numpy()
        return actions

    def remember(self, tried: Tried) -> None:
        """Add states to the memory, in place of the oldest."""
        memory = len(self._gains)
        rows = torch.arange(self._seen, self._seen + len(tried.values)) % memory
        gains = tried.values - tried.values[:, :1]
        self._observations[rows] = self._normal(tried.observations)
        self._gains[rows] = torch.from_numpy(gains.astype(np.float32))
        self._seen += len(gains)

    def improve(self, left: float) -> dict[str, float]:
        """Take gradient steps on random states of the memory.

        Args:
            left: remaining share of the rates, from 1 down.

        Returns:
            Figures for the log: the mean gain over action 0 that the policy expects, the mean
            gain of the best actions, and the entropy.
        """
        hyper, filled = self._hyper, min(self._seen, len(self._gains))
        for group in self._optimizer.param_groups:
            group["lr"] = hyper.learning_rate * left
        sums = np.zeros(3)
        for _ in range(hyper.gradient_steps):
            some = torch.randint(filled, (hyper.batch_size,))
            gains = self._gains[some]
            log_p = torch.log_softmax(self.network(self._observations[some]), 1)
            p = log_p.exp()
            expected = (p * gains).sum(1).mean()
            entropy = -(p * log_p).sum(1).mean()
            loss = -expected - hyper.ent_coef * left * entropy
            self._optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self._optimizer.step()
            sums += expected.item(), gains.amax(1).mean().item(), entropy.item()
        names = ("gain/expected", "gain/possible", "entropy")
        return dict(zip(names, (sums / hyper.gradient_steps).tolist(), strict=True))

    def state(self) -> dict[str, Any]:
        """Return all state that the future depends on, for :meth:`restore`."""
        return {
            "network": self.network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "observations": self._observations,
            "gains": self._gains,
            "seen": self._seen,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the learner, bit by bit, to the :meth:`state` of another."""
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(deepcopy(state["optimizer"]))  # else it keeps the tensors
        self._observations[:], self._gains[:] = state["observations"], state["gains"]
        self._seen = state["seen"]
