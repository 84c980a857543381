"""PPO of Stable-Baselines3 whose loops run on arrays: the same training in less time.

What is learned from an epoch takes many small operations of PyTorch and, for every environment, a
dictionary in Stable-Baselines3. Here environments write into the rollout, and actor and critic run
on numpy (:mod:`experiments.training.tanh_network`). Models, files, callbacks and figures
are the same.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecEnv

from experiments.training.native_steps import Ends, NativeSteps
from experiments.training.ppo_loss import Loss, PpoLoss, Taken, Weights, log_softmax
from experiments.training.rollout import Rollout, RunningNormalization, stack
from experiments.training.tanh_network import Gradients, Rows, TanhNetwork
from experiments.training.training_env import TrainingEnv
from mmwave_env.numerics.arrays import Index


class Networks(NamedTuple):
    """The networks of a policy, on the memory of its parameters."""

    actor: TanhNetwork
    critic: TanhNetwork
    gradients: Gradients
    loss: PpoLoss


class FastPPO(PPO):
    """PPO for tanh networks and discrete actions.

    Args:
        policy, env, **arguments: as of PPO.
        world: whose ``venv`` the environment is.

    Attributes:
        networks: actor and critic on arrays.
        steps: steps the environments.
        normalization: of what they show.
    """

    _last_obs: Any  # arrays, as the space is a box
    _last_episode_starts: Any

    def __init__(self, policy: Any, env: VecEnv, *, world: TrainingEnv, **arguments: Any) -> None:
        self._world = world
        super().__init__(policy, env, rollout_buffer_class=Rollout, **arguments)

    def _setup_model(self) -> None:
        super()._setup_model()
        policy: Any = self.policy
        gradients, extractor = Gradients(list(policy.parameters())), policy.mlp_extractor
        actor = TanhNetwork(extractor.policy_net, policy.action_net, gradients)
        critic = TanhNetwork(extractor.value_net, policy.value_net, gradients)
        loss = PpoLoss(actor, critic, gradients, self.batch_size)
        self.networks = Networks(actor, critic, gradients, loss)
        self.steps = NativeSteps(self._world)
        self.normalization = RunningNormalization(self._world.normal, self.n_envs)

    def _excluded_save_params(self) -> list[str]:
        """What a model's file leaves out: all that is made anew from the rest."""
        ours = ["_world", "networks", "steps", "normalization"]
        return [*super()._excluded_save_params(), *ours]

    # --- the rollout

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:  # fmt: skip
        """Fill the rollout with what the policy does; whether to go on."""
        rollout, steps = rollout_buffer, self.steps
        assert isinstance(rollout, Rollout)
        rollout.reset()
        callback.on_rollout_start()
        steps.take_over()
        rollout.seen[0] = self._last_obs
        rollout.episode_starts[0] = self._last_episode_starts
        cut: list[tuple[int, Index, Rows]] = []  # epoch, environments and what they saw last
        for t in range(n_rollout_steps):
            actions = self.draw(rollout.seen[t], rollout.logits[t])
            ends = steps.step(actions)
            self.num_timesteps += self.n_envs
            callback.update_locals({"infos": ends.infos if ends else []})
            if not callback.on_step():
                return False
            rollout.actions[t, :, 0], rollout.rewards[t] = actions, steps.rewards
            self._look_around(rollout, t)
            if ends:
                self._update_info_buffer(ends.infos)
                cut.append((t, *self._cut(rollout.seen[t], ends)))
            if t + 1 < n_rollout_steps:
                rollout.episode_starts[t + 1] = steps.over
        self.judge(rollout, cut)
        latest = rollout.seen[-1].copy()
        self._last_obs, self._last_episode_starts = latest, steps.over.copy()
        steps.hand_back()
        self._world.hand_back(latest)
        callback.on_rollout_end()
        return True

    def draw(self, seen: Rows, logits: Rows) -> Index:
        """Actions (n,), drawn as PyTorch's ``multinomial`` does: the first of exponential clocks.

        Args:
            seen: (n, features).
            logits: (actions, n), written.
        """
        logits[:] = self.networks.actor.all(seen)
        clocks = torch.empty(logits.shape[::-1]).exponential_().numpy().T
        chances = np.exp(logits - logits.max(axis=0))
        actions: Index = (chances / clocks).argmax(axis=0)
        return actions

    def _look_around(self, rollout: Rollout, t: int) -> None:
        """Write what is seen after an epoch."""
        observations, out = self.steps.observations, rollout.seen[t + 1]
        self.normalization.update(observations)
        features = observations.shape[1]
        if features == out.shape[1]:
            self.normalization.write(observations, out)
            return
        now = np.empty_like(observations)
        self.normalization.write(observations, now)
        stack(rollout.seen[t], now, self.steps.over, out)

    def _cut(self, before: Rows, ends: Ends) -> tuple[Index, Rows]:
        """Where episodes were cut off, and what the critic sees of their ends."""
        where, last = ends.where[ends.truncated], ends.observations[ends.truncated]
        seen = np.zeros((len(where), before.shape[1]), np.float32)
        now = np.empty_like(last)
        self.normalization.write(last, now)
        stack(before[where], now, np.zeros(len(where), np.bool_), seen)
        return where, seen

    def judge(self, rollout: Rollout, cut: list[tuple[int, Index, Rows]]) -> None:
        """Values, log-probabilities, advantages and returns of a rollout."""
        critic, shape = self.networks.critic, rollout.rewards.shape
        for t, where, seen in cut:
            rollout.rewards[t, where] += np.float32(self.gamma) * critic.all(seen)[0]
        values = critic.all(rollout.seen.reshape(-1, rollout.seen.shape[2]))[0]
        rollout.values[:] = values[: -self.n_envs].reshape(shape)
        log_p, _ = log_softmax(rollout.logits.swapaxes(0, 1))
        actions = rollout.actions.reshape(1, *shape).astype(np.int64)
        rollout.log_probs[:] = np.take_along_axis(log_p, actions, axis=0)[0]
        last = torch.from_numpy(values[-self.n_envs :])
        rollout.compute_returns_and_advantage(last, self.steps.over)
        rollout.pos, rollout.full = rollout.buffer_size, True

    # --- the update

    def train(self) -> None:
        """Improve the policy by what is in the rollout."""
        assert isinstance(self.rollout_buffer, Rollout)
        assert callable(self.clip_range)
        self._update_learning_rate(self.policy.optimizer)
        clip = self.clip_range(self._current_progress_remaining)
        weights = Weights(clip, self.ent_coef, self.vf_coef)
        taken, losses, latest = _taken(self.rollout_buffer), list[Loss](), 0
        self.networks.gradients.hand_over()
        for _ in range(self.n_epochs):
            latest = len(losses)
            near = self._pass(self.rollout_buffer, taken, weights, losses)
            self._n_updates += 1
            if not near:
                break
        self._log(losses, latest, clip)

    def _pass(self, rollout: Rollout, taken: Taken, weights: Weights, losses: list[Loss]) -> bool:
        """A gradient step for each batch; whether the policy is still near the one that acted."""
        gradients, size = self.networks.gradients, len(taken.actions)
        order = rollout.time_major(np.random.permutation(size))  # noqa: NPY002  as its buffer
        for first in range(0, size, self.batch_size):
            batch = order[first : first + self.batch_size]
            losses.append(self.networks.loss(taken, batch, weights))
            if self.target_kl is not None and losses[-1].approx_kl > 1.5 * self.target_kl:
                return False
            gradients.shorten(self.max_grad_norm)
            self.policy.optimizer.step()
        return True

    def _log(self, losses: list[Loss], latest: int, clip: float) -> None:
        """Record what Stable-Baselines3 does.

        Args:
            losses: of all batches.
            latest: the first of the last pass.
            clip: of the probability ratio.
        """
        means = {key: np.mean(values) for key, values in _columns(losses).items()}
        means["approx_kl"] = np.mean(_columns(losses[latest:])["approx_kl"])
        means["loss"] = np.float64(losses[-1].loss)
        for key, value in means.items():
            self.logger.record(f"train/{key}", value)
        rollout = self.rollout_buffer
        explained = explained_variance(rollout.values.ravel(), rollout.returns.ravel())
        self.logger.record("train/explained_variance", explained)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/clip_range", clip)


def _taken(rollout: Rollout) -> Taken:
    """All that was done in a rollout, epoch by epoch."""
    return Taken(
        rollout.observations.reshape(-1, rollout.observations.shape[2]),
        rollout.actions.ravel().astype(np.int64), rollout.log_probs.ravel(),
        rollout.advantages.ravel(), rollout.returns.ravel(),
    )  # fmt: skip


def _columns(losses: list[Loss]) -> dict[str, tuple[float, ...]]:
    return dict(zip(Loss._fields, zip(*losses, strict=True), strict=True))
