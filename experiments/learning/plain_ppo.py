"""PPO as CleanRL's ``ppo.py`` sets it (Huang et al., JMLR 23, 2022), on four environments.

CleanRL is a collection of files, not a library, so the algorithm is written out here; nothing in
it was chosen for this environment.
"""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.distributions import Categorical

from experiments.evaluation.agents import Act

ENVIRONMENTS, LENGTH = 4, 128  # steps of a rollout
MINIBATCHES, EPOCHS = 4, 4
DISCOUNT, LAMBDA = 0.99, 0.95
CLIP, RATE = 0.2, 2.5e-4
ENTROPY, VALUE = 0.01, 0.5  # shares of the loss
LARGEST_GRADIENT = 0.5


class ActorCritic(nn.Module):
    """Two networks of two hidden layers."""

    def __init__(self, features: int, actions: int) -> None:
        super().__init__()
        self.actor = _network(features, actions, gain=0.01)
        self.critic = _network(features, 1, gain=1.0)

    def forward(self, observations: Tensor) -> tuple[Categorical, Tensor]:
        """Chances of the actions, and values (n,)."""
        return Categorical(logits=self.actor(observations)), self.critic(observations)[..., 0]


def _network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    first, second, last = nn.Linear(inputs, 64), nn.Linear(64, 64), nn.Linear(64, outputs)
    for layer, of_layer in ((first, 2.0**0.5), (second, 2.0**0.5), (last, gain)):
        nn.init.orthogonal_(layer.weight, of_layer)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), last)


def advantages_of(rewards: Tensor, values: Tensor, ends: Tensor, last: Tensor) -> Tensor:
    """Generalized advantages (T, n) (Schulman et al. 2016); an end has no value after it.

    Args:
        rewards, values, ends: (T, n) of the steps; whether an episode ended with each.
        last: (n,) values after the last step.
    """
    found, gain, ahead = torch.zeros_like(rewards), torch.zeros_like(last), last
    for t in reversed(range(len(rewards))):
        goes_on = 1.0 - ends[t]
        surprise = rewards[t] + DISCOUNT * ahead * goes_on - values[t]
        found[t] = gain = surprise + DISCOUNT * LAMBDA * goes_on * gain
        ahead = values[t]
    return found


class _Rollouts:
    """Steps of an agent, a rollout after the other."""

    def __init__(self, envs: gym.vector.VectorEnv, agent: ActorCritic, seed: int) -> None:
        self._envs, self._agent = envs, agent
        self._now = torch.tensor(envs.reset(seed=seed)[0])

    @torch.no_grad()
    def next(self) -> list[Tensor]:
        """Observations, actions, their log chances, values and advantages of all steps."""
        steps: list[tuple[Tensor, ...]] = []
        for _ in range(LENGTH):
            choice, value = self._agent(self._now)
            action = choice.sample()
            after, reward, terminated, truncated, _ = self._envs.step(action.numpy())
            ends = torch.tensor(terminated | truncated, dtype=torch.float32)
            paid = torch.tensor(reward, dtype=torch.float32)
            steps.append((self._now, action, choice.log_prob(action), value, paid, ends))
            self._now = torch.tensor(after)
        seen, acted, chances, values, rewards, over = map(torch.stack, zip(*steps, strict=True))
        advantages = advantages_of(rewards, values, over, self._agent(self._now)[1])
        return [x.flatten(0, 1) for x in (seen, acted, chances, values, advantages)]


def _loss(agent: ActorCritic, batch: list[Tensor]) -> Tensor:
    seen, acted, chances, values, advantages = batch
    choice, value = agent(seen)
    ratio = (choice.log_prob(acted) - chances).exp()
    gain = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    of_actor = torch.max(-gain * ratio, -gain * ratio.clamp(1.0 - CLIP, 1.0 + CLIP)).mean()
    returns, near = advantages + values, values + (value - values).clamp(-CLIP, CLIP)
    of_critic: Tensor = 0.5 * torch.max((value - returns) ** 2, (near - returns) ** 2).mean()
    entropy: Tensor = choice.entropy().mean()
    loss: Tensor = of_actor - ENTROPY * entropy + VALUE * of_critic
    return loss


def train(envs: gym.vector.VectorEnv, steps: int, seed: int) -> Act:
    """An agent that takes its most probable action.

    Args:
        envs: ``ENVIRONMENTS`` of them, which begin the next episode in the step that ends one.
        steps: to train for, of all environments together.
        seed: of the network, the actions and the episodes.
    """
    torch.manual_seed(seed)
    space: Any = envs.single_action_space
    agent = ActorCritic(envs.single_observation_space.shape[0], int(space.n))  # type: ignore[index]
    optimizer = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)
    rollouts, size = _Rollouts(envs, agent, seed), ENVIRONMENTS * LENGTH
    updates = max(1, steps // size)
    for update in range(updates):
        optimizer.param_groups[0]["lr"] = RATE * (1.0 - update / updates)
        rollout = rollouts.next()
        for _ in range(EPOCHS):
            for some in torch.randperm(size).reshape(MINIBATCHES, -1):
                optimizer.zero_grad()
                _loss(agent, [x[some] for x in rollout]).backward()  # type: ignore[no-untyped-call]
                nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
                optimizer.step()

    def act(observations: NDArray[np.float32]) -> NDArray[np.int64]:
        with torch.no_grad():
            found: NDArray[np.int64] = agent(torch.tensor(observations))[0].probs.argmax(1).numpy()
        return found

    return act
