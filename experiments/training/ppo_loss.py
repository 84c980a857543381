"""PPO's loss (Schulman et al. 2017) over a batch, and its gradient.

    r = exp(log p(a) - log p_old(a))
    L = -mean min(A r, A clip(r, 1 - c, 1 + c)) - e mean H + v mean (V - R)^2

with the entropy H of the policy p, normalized advantages A and returns R.
"""

from typing import NamedTuple

import numpy as np

from experiments.training.tanh_network import ROWS, Gradients, Rows, TanhNetwork
from mmwave_env.numerics.arrays import Index


class Taken(NamedTuple):
    """Actions that were taken, with what is known of them afterwards.

    Attributes:
        observations: (k, features).
        actions: (k,).
        log_probs: (k,) of the actions, at the policy that took them.
        advantages, returns: (k,).
    """

    observations: Rows
    actions: Index
    log_probs: Rows
    advantages: Rows
    returns: Rows

    def rows(self, where: Index, room: Rows) -> "Taken":
        """Some of them (k,); their observations are written into ``room`` (k or more, features)."""
        # "clip" spares a buffer: no index is beyond the end
        seen = np.take(self.observations, where, axis=0, out=room[: len(where)], mode="clip")
        return Taken(
            seen, self.actions.take(where), self.log_probs.take(where),
            self.advantages.take(where), self.returns.take(where),
        )  # fmt: skip


class Weights(NamedTuple):
    """What weighs what in the loss.

    Attributes:
        clip: c, largest change of a probability ratio that pays.
        entropy: e.
        value: v.
    """

    clip: float
    entropy: float
    value: float


class Loss(NamedTuple):
    """Means over a batch; the names are those of Stable-Baselines3's figures."""

    policy_gradient_loss: float
    value_loss: float
    entropy_loss: float
    clip_fraction: float
    approx_kl: float
    loss: float


class PpoLoss:
    """The loss of an actor and a critic.

    Args:
        actor: gives logits of actions.
        critic: gives a value.
        gradients: of both.
        size: of the largest batch.
    """

    def __init__(
        self, actor: TanhNetwork, critic: TanhNetwork, gradients: Gradients, size: int
    ) -> None:
        self._actor, self._critic, self._gradients = actor, critic, gradients
        self._log_ratio, self._entropy, self._gain, self._error = np.zeros((4, size), np.float32)
        self._clipped = np.zeros(size, np.bool_)
        self._columns = np.arange(ROWS)

    def __call__(self, taken: Taken, batch: Index, weights: Weights) -> Loss:
        """The loss over a batch, rows (k,) of what was taken; the gradients are set to its own."""
        size, advantages = len(batch), taken.advantages.take(batch)
        if size > 1:
            deviation = advantages.std(ddof=1)
            advantages = (advantages - advantages.mean()) / (deviation + np.float32(1e-8))
        self._gradients.flat[:] = 0.0
        room = self._gradients.room("seen", 0, taken.observations.shape[1])
        for first in range(0, size, ROWS):
            here = slice(first, min(first + ROWS, size))
            block = taken.rows(batch[here], room)._replace(advantages=advantages[here])
            self._add(block, here, size, weights)
        log_ratio = self._log_ratio[:size]
        policy = -float(self._gain[:size].mean())
        error, entropy = self._error[:size], float(self._entropy[:size].mean())
        value = float(error @ error) / size
        return Loss(
            policy, value, -entropy, float(self._clipped[:size].mean()),
            float((np.expm1(log_ratio) - log_ratio).mean()),
            policy - weights.entropy * entropy + weights.value * value,
        )  # fmt: skip

    def _add(self, block: Taken, here: slice, size: int, weights: Weights) -> None:
        """Add the gradient of some rows; note what the means are of, in their place of a batch."""
        error = np.subtract(self._critic.forward(block.observations)[0], block.returns,
                            out=self._error[here])  # fmt: skip
        slopes = error * np.float32(2.0 * weights.value / size)
        self._critic.backward(block.observations, slopes[None])

        log_p, p = log_softmax(self._actor.forward(block.observations))
        taken = block.actions * len(block.actions) + self._columns[: len(block.actions)]
        log_ratio = np.subtract(log_p.take(taken), block.log_probs, out=self._log_ratio[here])
        ratio = np.exp(log_ratio)
        low, high = np.float32(1.0 - weights.clip), np.float32(1.0 + weights.clip)
        gain = block.advantages * ratio
        bounded = block.advantages * np.clip(ratio, low, high)
        np.minimum(gain, bounded, out=self._gain[here])
        np.greater(np.abs(ratio - np.float32(1.0)), np.float32(weights.clip),
                   out=self._clipped[here])  # fmt: skip
        # d log p(a) / d logits = [k = a] - p;  dH / d logits = -p (log p + H)
        by_action = np.where(gain <= bounded, gain, np.float32(0.0)) * np.float32(-1.0 / size)
        entropy = np.einsum("ij,ij->j", p, log_p, out=self._entropy[here])
        np.negative(entropy, out=entropy)
        slopes = (log_p + entropy) * np.float32(weights.entropy / size)
        slopes -= by_action
        slopes *= p
        slopes.reshape(-1)[taken] += by_action
        self._actor.backward(block.observations, slopes)


def log_softmax(logits: Rows) -> tuple[Rows, Rows]:
    """Logarithms of probabilities and these themselves, of logits (actions, ...)."""
    log_p = logits - logits.max(axis=0)
    p = np.exp(log_p)
    total = p.sum(axis=0)
    p /= total
    log_p -= np.log(total)
    return log_p, p
