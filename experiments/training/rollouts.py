"""Training of a policy by rollout policy iteration with common random numbers.

In states that the current policy visits, every action is tried on the same measurements, and the
greedy policy acts for some epochs after the action (:class:`RolloutEnv`). Then the network learns
to prefer the better actions (:class:`RolloutLearner`), and both steps repeat. This is rollout
policy iteration (Bertsekas, Rollout, Policy Iteration, and Distributed Reinforcement Learning,
2020). Actions do not change measurements, so the values of actions are exact up to the horizon.
A *place* is a scene with a radio.
"""

from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn

from experiments.evaluation.agents import Act
from experiments.evaluation.branches import Branches
from experiments.training.hyperparameters import RolloutHyperparameters, falling
from experiments.training.networks import perceptron
from experiments.training.trainer import Job, Trainer
from experiments.training.training_task import TrainingTask
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.engines.engine import Engine
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.world.keys import Streams
from policies.policy_file import Tensors
from policies.sb3 import Normalization, actor_tensors

CONSTANT = 1e-4  # added to standard deviations, which are 0 for a feature that never changes


class Tried(NamedTuple):
    """States in which every action was tried.

    Attributes:
        observations: (k, features) observations in the states.
        values: (k, actions) sum of the discounted rewards of an action and the actions after it.
    """

    observations: Array32
    values: Array


class RolloutEnv:
    """A set of n environments at the places of a task; a place is a scene with a radio.

    All places share a program, so the modes of their banks may differ only in their tuning.
    A group of eight adjacent environments has one place, and all eight are in the same epoch. The
    groups' first episodes are cut to different lengths, so that later their epochs differ.

    Args:
        task: task of the training.
        n: number of environments, a multiple of eight, and at least eight per place.
        horizon: length of a rollout, epochs.
        discount: weight of a reward that comes one second later, 0 to 1.
        seed: seed of the first environment; the other seeds count up from it.

    Attributes:
        observation: definition of the observed features.
        observations: (n, features) observations of the current states.
    """

    def __init__(
        self, task: TrainingTask, n: int, horizon: int, discount: float, seed: int
    ) -> None:
        places = task.places
        self._sources = [place.source(task.scenario) for place in places]
        self._everyone = np.arange(n)
        block = self._everyone // WIDTH
        self._place = block % len(places)
        pipeline = Pipeline(task.bank.modes, self._sources[0].layout)
        bank = task.bank if task.beliefs == "per-mode" else None
        self._engine = Engine(pipeline, n, task.reward, task.observation, bank)
        self.observation = self._engine.observation
        self._branches = Branches(self._engine, horizon)
        if bank:
            for i, place in enumerate(places):
                here = np.flatnonzero(self._place == i)
                self._engine.tune(task.banks[place.profile], here)
        step_s = np.array([place.dt for place in places])[self._place]
        self._weights = discount ** (step_s[:, None] * np.arange(horizon))
        self._streams = Streams(n)
        self._streams.seed_some(seed, self._everyone)
        self.observations = np.zeros((n, len(self.observation)), np.float32)
        self._begin(self._everyone)
        length = self._engine.state.length
        length[:] = 1 + block * (length - 1) // (block[-1] + 1)

    def step(self, actions: Index) -> None:
        """Take the actions (n,), one in every environment; start a new episode where one ends."""
        self.observations = self._engine.step(actions)
        state = self._engine.state
        over = np.flatnonzero(state.epoch > state.length)
        if len(over):
            self._begin(over)

    def _begin(self, some: Index) -> None:
        """Start new episodes in the environments with the indices ``some`` (k,)."""
        for i, source in enumerate(self._sources):
            here = some[self._place[some] == i]
            if len(here):
                self._engine.load(source.sample_batch(self._streams.keys(here)), here)
        begun = self._engine.step(places=some)
        self.observations[some] = begun[some]

    def measured_normalization(self, clip: float) -> Normalization:
        """Take action 0 for the length of an episode; return the observations' normalization.

        Args:
            clip: number of standard deviations from the mean at which observations are clipped.
        """
        parts = []
        for _ in range(max(source.epochs for source in self._sources)):
            self.step(np.zeros_like(self._everyone))
            parts.append(self.observations)
        observations = np.concatenate(parts)
        mean = observations.mean(0)
        sigma = observations.std(0) + CONSTANT
        return Normalization.clipped(mean, sigma, clip)

    def try_all(self, act: Act) -> Tried:
        """Try every action in each environment whose episode goes on for at least the horizon.

        Args:
            act: function that chooses the actions after the tried action, given observations
                (actions * n, features) of copies of the environments: first the n copies that
                began with action 0, then the n copies that began with action 1, and so on.
        """
        values = self._branches.values(act, self._weights)
        state = self._engine.state
        whole = state.epoch - 1 + self._branches.horizon <= state.length
        return Tried(self.observations[whole], values[whole])


class RolloutLearner:
    """The network, its optimizer and the states that it learns from.

    The memory has states s in which every action a was tried. After a, the network chose actions
    with the weights it had then. Q(s, a) is the value of a; pi(a | s) is its current probability.
    Training maximizes the mean of sum_a pi(a | s) (Q(s, a) - Q(s, 0)) and a small entropy bonus.

    Args:
        features, actions: numbers of features and of actions.
        hyper, normal: hyperparameters, and normalization of an observation.

    Attributes:
        network, optimizers: the network and the optimizer of its weights.
        scales: the fields of the normalization, by name.
    """

    def __init__(
        self, features: int, actions: int, hyper: RolloutHyperparameters, normal: Normalization
    ) -> None:
        self._hyper = hyper
        self.scales = normal._asdict()
        network = perceptron(features, *hyper.hidden, actions)
        last = cast(nn.Linear, network[-1])
        with torch.no_grad():
            last.weight *= 0.1
            last.bias.zero_()
            last.bias[0] = hyper.first_action_bias
        self.network: nn.Module = network
        adam = torch.optim.Adam(network.parameters(), hyper.learning_rate)
        self.optimizers: tuple[torch.optim.Optimizer, ...] = (adam,)
        self._observations = torch.empty((hyper.memory, features))
        self._gains = torch.empty((hyper.memory, actions))
        self._seen = 0

    def _logits(self, observations: Array32) -> Tensor:
        logits: Tensor = self.network(self._normal(observations))
        return logits

    def _normal(self, observations: Array32) -> Tensor:
        return torch.from_numpy(Normalization(**self.scales).normalized(observations))

    @torch.no_grad()
    def greedy(self, observations: Array32) -> Index:
        """Return the most probable actions (n,) for observations (n, features)."""
        return self._logits(observations).argmax(1).numpy()

    @torch.no_grad()
    def sampled(self, observations: Array32) -> Index:
        """Draw actions (n,) with the network's probabilities, for observations (n, features)."""
        probabilities = torch.softmax(self._logits(observations), 1)
        return torch.multinomial(probabilities, 1)[:, 0].numpy()

    def remember(self, tried: Tried) -> None:
        """Add states to the memory; they replace the oldest states."""
        rows = torch.arange(self._seen, self._seen + len(tried.values)) % len(self._gains)
        gains = tried.values - tried.values[:, :1]
        self._observations[rows] = self._normal(tried.observations)
        self._gains[rows] = torch.from_numpy(gains.astype(np.float32))
        self._seen += len(gains)

    def improve(self, left: float) -> None:
        """Take gradient steps on random states from the memory.

        Args:
            left: share of the learning rate and of the entropy bonus that remains, 1 at the start.
        """
        hyper = self._hyper
        filled = min(self._seen, len(self._gains))
        (adam,) = self.optimizers
        adam.param_groups[0]["lr"] = hyper.learning_rate * left
        for _ in range(hyper.gradient_steps):
            some = torch.randint(filled, (hyper.batch_size,))
            log_p = torch.log_softmax(self.network(self._observations[some]), 1)
            p = log_p.exp()
            expected = (p * self._gains[some]).sum(1).mean()
            entropy = -(p * log_p).sum(1).mean()
            loss = -expected - hyper.ent_coef * left * entropy
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()


class RolloutTrainer(RolloutLearner, Trainer):
    """The updates of rollout policy iteration; timesteps are states in which actions were tried.

    Args:
        job: training to run.
        seed: seed of all random numbers.

    Attributes:
        env: environments in which actions are tried.
    """

    EVERY = 8

    def __init__(self, job: Job, seed: int) -> None:
        torch.manual_seed(seed)
        hyper: RolloutHyperparameters = job.hyperparameters
        self.judged = job.task
        self.env = RolloutEnv(job.task, hyper.num_envs, hyper.horizon, hyper.gamma, seed)
        self.table = self.env.observation
        normal = self.env.measured_normalization(hyper.clip_observation)
        super().__init__(len(self.table), len(self.table.actions), hyper, normal)

    def update(self, left: float) -> int:
        """Try all actions in some states and learn; return the number of states."""
        env = self.env
        new = 0
        while new < self._hyper.states:
            tried = env.try_all(self.greedy)
            self.remember(tried)
            new += len(tried.values)
            for _ in range(self._hyper.stride):
                env.step(self.sampled(env.observations))
        self.improve(falling(self._hyper.final_fraction, left))
        return new

    def tensors(self) -> Tensors:
        """Return the network in the form that a policy file stores."""
        return actor_tensors(self.network.children(), Normalization(**self.scales))
