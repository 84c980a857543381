"""Training of a corrector by supervision on simulated episodes.

A corrector corrects the beliefs of another policy, its base. In a simulation the truth is known, so
the network learns the errors of the base from examples. The loss has two terms. The first is the
length of the remaining error, divided by the length of the vector of standard deviations (its mean
over the episode). The second, with a small weight, is the negative log-likelihood of this error; it
teaches the network to scale the standard deviations. The base does not depend on corrections, so it
plays each episode only once, in *lots* (batches of equally long episodes), and the network learns
from every lot in some successive updates.

The two-way corrector, which corrects smoothed tracks, learns from the same kinds of episodes, but
after smoothing, and reads every track forwards and backwards. Smoothing takes longer than learning,
so all episodes are played first; then the network learns from each of them several times.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from experiments.console.options import TUNING_SEED
from experiments.training.corrector_data import (
    Lot,
    TrainingEpisodes,
    filtered,
    lot_of,
    smoothed,
)
from experiments.training.hyperparameters import (
    CorrectorHyperparameters,
    TwoWayHyperparameters,
    falling,
)
from experiments.training.networks import CorrectorNetwork
from experiments.training.trainer import Job, Trainer
from experiments.training.training_task import TrainingTask, places_from
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import Json
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.layout import Layout
from policies.policy_file import PolicyFile, Tensors
from policies.sb3 import Normalization

FIRST = 4  # number of rounds of lots in the first update, to measure the features' ranges
ROUNDS = 2  # number of rounds in every other update
PASSES = 3  # number of updates that learn from the same lots: playing takes longer than learning
OUTSIDE = 2e-4  # share of a feature's values below its lower limit, and also above its upper limit
# limits in the loss, so that lost tracks do not dominate it
MOST_LENGTH = 20.0
MOST_SQUARE = 18.0
# Mean error of the base, in standard deviations, from which on an episode counts less; else a few
# episodes with a bad survey would outweigh all others
LARGE = 2.0
CONSTANT = 1e-3  # added to standard deviations, which are 0 for a feature that never changes


def normalization_of(rows: NDArray[Any]) -> Normalization:
    """Return the normalization of features, given many of their values (n, features)."""
    low, high = np.quantile(rows, (OUTSIDE, 1.0 - OUTSIDE), axis=0)
    sigma = rows.std(0, np.float64) + CONSTANT
    return Normalization(low, high, rows.mean(0, np.float64), sigma)


def loss_of(
    answer: tuple[Tensor, Tensor], error: Tensor, deviation: Tensor, weight: float
) -> Tensor:
    """Return the loss (n, members) of every ensemble member in every episode.

    Args:
        answer: output of :meth:`CorrectorNetwork.forward`.
        error, deviation: (T, n, 3) as in :class:`Lot`.
        weight: weight of the log-likelihood.
    """
    shift = answer[0][BURN_IN:]
    log_factor = answer[1][BURN_IN:]
    deviation = deviation[BURN_IN:, :, None]
    left = error[BURN_IN:, :, None] / deviation - shift  # remaining error, in standard deviations
    size = deviation.norm(dim=-1).mean(0)
    base_error = error[BURN_IN:, :, None].norm(dim=-1).mean(0)
    size = torch.maximum(size, base_error / LARGE)
    length = ((left * deviation).square().sum(-1) + 1e-6).sqrt() / size
    square = (left * (-log_factor).exp()).square().clamp(max=MOST_SQUARE)
    likelihood = (0.5 * square + log_factor).sum(-1)
    loss: Tensor = length.clamp(max=MOST_LENGTH).mean(0) + weight * likelihood.mean(0)
    return loss


def optimizers_of(network: CorrectorNetwork, rate: float) -> tuple[torch.optim.Optimizer, ...]:
    """Return Muon (Jordan et al. 2024) for the matrices of hidden layers, and Adam for the rest."""
    others = dict(network.named_parameters())
    names = [name for name, weights in others.items() if weights.ndim == 2 and name != "out.weight"]
    hidden = [others.pop(name) for name in names]
    muon = torch.optim.Muon(hidden, rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    return muon, torch.optim.Adam(others.values(), rate)


class CorrectorTrainer(Trainer):
    """The updates of a corrector; timesteps are epochs from which it learns.

    Args:
        job: training to run.
        seed: seed of all random numbers.

    Attributes:
        TWO_WAY, BELIEFS: whether the network also reads tracks backwards, and the function that
            computes the beliefs to correct.
    """

    EVERY = 24
    TWO_WAY = False
    BELIEFS = staticmethod(filtered)

    def __init__(self, job: Job, seed: int) -> None:
        torch.manual_seed(seed)
        self.hyper: CorrectorHyperparameters = job.hyperparameters
        places = places_from(self.hyper.judged_at)
        # the training's bank, or its first bank for a radio that it does not use
        banks = {p.profile: job.task.banks.get(p.profile, job.task.bank) for p in places}
        self.judged = replace(job.task, places=places, banks=banks)
        self.base = self.hyper.base
        self.seed = seed
        self.play = self.player(job.task, seed, self.hyper.random_share)
        pipeline = Pipeline(job.task.bank.modes, Layout())
        table = Observation(pipeline, "signed", "per-mode")
        self.table = table.only(after_update(pipeline))
        self.network = CorrectorNetwork(len(self.table), self.hyper, self.TWO_WAY)
        self.optimizers = optimizers_of(self.network, self.hyper.learning_rate)
        self.scales = {}
        self._updates = enumerate(self.lots())

    def player(self, task: TrainingTask, seed: int, share: float) -> Callable[[int], list[Lot]]:
        """Return a function that plays some rounds of new episodes of a task.

        Args:
            task, seed: task, and the seed from which all episodes follow.
            share: share of random episodes.
        """
        hyper = self.hyper
        episodes = TrainingEpisodes(
            task.scenario, task.places, seed, hyper.num_envs, share, hyper.long_epochs
        )

        def play(rounds: int) -> list[Lot]:
            batches = episodes.batches(rounds)
            return [lot_of(self.BELIEFS(b, task.banks[radio], self.base)) for radio, b in batches]

        return play

    def lots(self) -> Iterator[list[Lot]]:
        """Yield the lots of each update: episodes at the task's places and in random streets.

        Also set the scales, unless they are restored from a checkpoint.
        """
        if not self.scales:
            first = self.play(FIRST)
            self.measure(first)
            yield from [first] * PASSES
        while True:
            yield from [self.play(ROUNDS)] * PASSES

    def update(self, left: float) -> int:
        """Mix the episodes of the next lots, and take a gradient step for each new lot."""
        number, lots = next(self._updates)
        rng = np.random.default_rng((self.seed, number))
        rate = self.hyper.learning_rate * falling(self.hyper.final_fraction, left)
        for optimizer in self.optimizers:
            optimizer.param_groups[0]["lr"] = rate
        for lot in mixed(lots, self.hyper.batch_size, rng):
            self._step(lot)
        return sum(lot.features[..., 0].size for lot in lots)

    def measure(self, lots: list[Lot]) -> None:
        """Set the scales from the features in some lots: limits, mean and standard deviation."""
        rows = np.concatenate([lot.features.reshape(-1, lot.features.shape[2]) for lot in lots])
        self.scales.update(normalization_of(rows)._asdict())

    def _step(self, lot: Lot) -> None:
        """Take a gradient step; each member of an ensemble learns from about half of the lot."""
        hyper = self.hyper
        error = torch.from_numpy(lot.error)
        deviation = torch.from_numpy(lot.deviation)
        losses = loss_of(self.answer(lot), error, deviation, hyper.likelihood_weight)
        some = torch.rand(losses.shape) < (0.5 if hyper.members > 1 else 1.0)
        loss = (losses * some).sum() / some.sum().clamp(min=1)
        self.network.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self.network.parameters(), hyper.max_grad_norm)
        for optimizer in self.optimizers:
            optimizer.step()

    def answer(self, lot: Lot) -> tuple[Tensor, Tensor]:
        """Return the network's outputs for a lot; see :meth:`CorrectorNetwork.forward`."""
        features = Normalization(**self.scales).normalized(lot.features)
        answer: tuple[Tensor, Tensor] = self.network(torch.from_numpy(features))
        return answer

    def tensors(self) -> Tensors:
        """Return the network in the form that a policy file stores."""
        normal = Normalization(**self.scales)
        tensors = {"low": normal.low, "high": normal.high}
        for name, value in self.network.state_dict().items():
            stored = re.sub(r"gru(.*)_l0_reverse", r"back\1", name).removesuffix("_l0")
            tensors[stored] = value.numpy().astype(float)
        front = tensors["front.weight"], tensors["front.bias"]
        tensors["front.weight"], tensors["front.bias"] = normal.folded(*front)
        return {name: value.astype(np.float32) for name, value in tensors.items()}


def mixed(lots: list[Lot], size: int, rng: np.random.Generator) -> Iterator[Lot]:
    """Yield all episodes in random order, in new lots that mix episodes of different places.

    Args:
        lots: lots to mix.
        size: number of episodes in a new lot, if they have the least length. Lots of longer
            episodes have fewer episodes, so that all lots have about the same number of epochs.
        rng: random generator of the order.
    """
    lengths = sorted({len(lot.features) for lot in lots})
    parts = []
    for length in lengths:
        alike = [lot for lot in lots if len(lot.features) == length]
        together = Lot(*(np.concatenate(part, axis=1) for part in zip(*alike, strict=True)))
        order = rng.permutation(together.features.shape[1])
        count = max(1, round(len(order) * length / (size * lengths[0])))
        parts += [(together, some) for some in np.array_split(order, count)]
    for i in rng.permutation(len(parts)):
        together, some = parts[i]
        yield Lot(*(part[:, some] for part in together))


TOGETHER = 18  # number of lots whose episodes are mixed


class TwoWayTrainer(CorrectorTrainer):
    """The updates of a two-way corrector.

    All episodes are played before the first update. Every update learns from some of their lots;
    ``EVERY`` updates are about one pass over all lots.
    """

    EVERY = 16
    TWO_WAY = True
    BELIEFS = staticmethod(smoothed)

    def lots(self) -> Iterator[list[Lot]]:
        """Yield the lots of each update, pass after pass, each time in a new order."""
        assert isinstance(self.hyper, TwoWayHyperparameters)
        rng = np.random.default_rng(self.seed)
        lots = self.play(self.hyper.rounds)
        if not self.scales:
            self.measure(lots[: 4 * TOGETHER])
        while True:
            for some in np.array_split(rng.permutation(len(lots)), -(-len(lots) // TOGETHER)):
                yield [lots[i] for i in some]

    def examiner(self, episodes: int) -> Callable[[PolicyFile], Json]:
        """Return a function that evaluates the network by the errors of new tracks.

        Its results are "reward", the negative mean error (m) of corrected tracks, and "smoothed_m",
        the mean error before the correction.
        """
        lots = self.player(self.judged, TUNING_SEED, 0.0)(1)

        @torch.no_grad()
        def examine(_: PolicyFile) -> Json:
            shifts = [self.answer(lot)[0].mean(dim=2).numpy() * lot.deviation for lot in lots]
            left = [lot.error - shift for lot, shift in zip(lots, shifts, strict=True)]
            return {
                "reward": -_mean_length(left),
                "smoothed_m": _mean_length([lot.error for lot in lots]),
            }

        return examine


def _mean_length(errors: Iterable[NDArray[Any]]) -> float:
    """Return the mean length of errors, arrays (T, n, 3), in scored epochs; lots count equally."""
    return float(np.mean([np.linalg.norm(e[BURN_IN:], axis=-1).mean() for e in errors]))
