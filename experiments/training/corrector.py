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
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from experiments.console.options import TUNING_SEED
from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import run_contender
from experiments.training.corrector_data import CorrectorData, Lot, base_policy, lot_of
from experiments.training.hyperparameters import (
    CorrectorHyperparameters,
    TwoWayHyperparameters,
    falling,
)
from experiments.training.recurrence import RecurrentUnit
from experiments.training.trainer import Job, Trainer
from experiments.training.training_task import places_from
from mmwave_env.engines.smoothing import GATES, smoothed_features
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import Json
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.numbers import Array, Array32
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import EpisodeBatch, columns_of
from policies.policy_file import CORRECTIONS, Tensors
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


class CorrectorNetwork(nn.Module):
    """A network: a tanh layer, a gated recurrent unit, and a head with outputs for an ensemble.

    With ``two_way``, a second recurrent unit reads the epochs backwards.
    """

    def __init__(
        self, features: int, hyper: CorrectorHyperparameters, two_way: bool = False
    ) -> None:
        super().__init__()
        self.front = nn.Linear(features, hyper.front)
        self.gru = RecurrentUnit(hyper.front, hyper.units, bidirectional=two_way)
        self.head = nn.Linear((1 + two_way) * hyper.units + hyper.front, hyper.head)
        self.out = nn.Linear(hyper.head, hyper.members * CORRECTIONS)
        with torch.no_grad():
            self.out.weight *= 0.1  # at first, corrections are small
            self.out.bias.zero_()

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Map features (T, n, F) to shifts and log factors of sigmas: (T, n, members, 3) each."""
        front = torch.tanh(self.front(features))
        memory = self.gru(front)
        head = torch.tanh(self.head(torch.cat([memory, front], -1)))
        answer = self.out(head).unflatten(-1, (-1, CORRECTIONS))
        return answer[..., :3], answer[..., 3:]


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
    hidden: list[Tensor] = []
    others: list[Tensor] = []
    for name, weights in network.named_parameters():
        matrix = weights.ndim == 2 and name != "out.weight"
        (hidden if matrix else others).append(weights)
    muon = torch.optim.Muon(hidden, rate, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    return muon, torch.optim.Adam(others, rate)


class CorrectorTrainer(Trainer):
    """The updates of a corrector; timesteps are epochs from which it learns.

    Args:
        job: training to run.
        seed: seed of all random numbers.

    Attributes:
        TWO_WAY, DATA: whether the network also reads tracks backwards, and the source of lots.
    """

    EVERY = 24
    TWO_WAY = False
    DATA = CorrectorData

    def __init__(self, job: Job, seed: int) -> None:
        torch.manual_seed(seed)
        self.hyper: CorrectorHyperparameters = job.hyperparameters
        places = places_from(self.hyper.judged_at)
        # the training's bank, or its first bank for a radio that it does not use
        banks = {p.profile: job.task.banks.get(p.profile, job.task.bank) for p in places}
        self.judged = replace(job.task, places=places, banks=banks)
        self.base = self.hyper.base
        self.seed = seed
        self.data = self.DATA(job.task, self.hyper, seed)
        pipeline = Pipeline(job.task.bank.modes, Layout())
        table = Observation(pipeline, "signed", "per-mode")
        self.table = table.only(after_update(pipeline, per_mode=True))
        self.network = CorrectorNetwork(len(self.table), self.hyper, self.TWO_WAY)
        self.optimizers = optimizers_of(self.network, self.hyper.learning_rate)
        self.scales = {}
        self._updates = enumerate(self.lots())

    def lots(self) -> Iterator[list[Lot]]:
        """Yield the lots of each update: episodes at the task's places and in random streets.

        Also set the scales, unless they are restored from a checkpoint.
        """
        if not self.scales:
            first = list(self.data.lots(FIRST))
            self.measure(first)
            yield from [first] * PASSES
        while True:
            yield from [list(self.data.lots(ROUNDS))] * PASSES

    def update(self, left: float) -> tuple[int, dict[str, float]]:
        """Mix the episodes of the next lots, and take a gradient step for each new lot."""
        number, lots = next(self._updates)
        rng = np.random.default_rng((self.seed, number))
        rate = self.hyper.learning_rate * falling(self.hyper.final_fraction, left)
        for optimizer in self.optimizers:
            optimizer.param_groups[0]["lr"] = rate
        losses = [self._step(lot) for lot in mixed(lots, self.hyper.batch_size, rng)]
        epochs = sum(lot.features[..., 0].size for lot in lots)
        return epochs, {"loss": float(np.mean(losses))}

    def measure(self, lots: list[Lot]) -> None:
        """Set the scales from the features in some lots: limits, mean and standard deviation."""
        rows = np.concatenate([lot.features.reshape(-1, lot.features.shape[2]) for lot in lots])
        self.scales.update(normalization_of(rows)._asdict())

    def _step(self, lot: Lot) -> float:
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
        return loss.item()

    def answer(self, lot: Lot) -> tuple[Tensor, Tensor]:
        """Return the network's outputs for a lot; see :meth:`CorrectorNetwork.forward`."""
        low, high, mean, sigma = (
            torch.as_tensor(s, dtype=torch.float32) for s in Normalization(**self.scales)
        )
        features = torch.from_numpy(lot.features)
        answer: tuple[Tensor, Tensor] = self.network((features.clamp(low, high) - mean) / sigma)
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
PARTS = ("x", "mixture", *(f"memory.{gate}" for gate in GATES))


class Smoothed(NamedTuple):
    """Smoothed tracks of n episodes of T epochs each.

    Attributes:
        features: (n, T, features) features for the network.
        x, P: (n, T, 7) means and (n, T, 28) packed covariances.
        error: (n, T, 3) estimate minus truth, m.
    """

    features: Array32
    x: Array
    P: Array
    error: Array


def smoothed(batch: EpisodeBatch, bank: Bank, base: str) -> Smoothed:
    """Filter episodes with the policy ``base`` and a bank, and smooth the tracks."""
    pipeline = Pipeline(bank.modes, batch.layout)
    at = columns_of(batch.layout)
    contender = Contender(bank, policy=partial(base_policy, base), name=base)
    of = run_contender(contender, batch, after=PARTS)
    hz_per_mps = float(unflatten(blank_site(batch.layout), iter(batch.site[0])).hz_per_mps)
    dt = batch.table[:, :, at.dt]
    spread_hz = batch.table[:, :, at.doppler_spread_hz]
    x, P = smooth_modes(bank, pipeline, of["mixture"], dt, spread_hz, hz_per_mps)
    gates = [of[f"memory.{gate}"] for gate in GATES]
    features = smoothed_features(pipeline, batch, x, P, of["mixture"], gates)
    return Smoothed(features, x, P, of["error"] + (x - of["x"])[..., :3])


class SmoothedData(CorrectorData):
    """A source of lots of smoothed tracks, with their features, errors and deviations."""

    def _play(self, batch: EpisodeBatch, bank: Bank) -> Lot:
        return lot_of(*smoothed(batch, bank, self._hyper.base))


class TwoWayTrainer(CorrectorTrainer):
    """The updates of a two-way corrector.

    All episodes are played before the first update. Every update learns from some of their lots;
    ``EVERY`` updates are about one pass over all lots.
    """

    EVERY = 16
    TWO_WAY = True
    DATA = SmoothedData

    def lots(self) -> Iterator[list[Lot]]:
        """Yield the lots of each update, pass after pass, each time in a new order."""
        assert isinstance(self.hyper, TwoWayHyperparameters)
        rng = np.random.default_rng(self.seed)
        lots = list(self.data.lots(self.hyper.rounds))
        if not self.scales:
            self.measure(lots[: 4 * TOGETHER])
        while True:
            for some in np.array_split(rng.permutation(len(lots)), -(-len(lots) // TOGETHER)):
                yield [lots[i] for i in some]

    def examiner(self, episodes: int) -> Callable[[Path], Json]:
        """Return a function that evaluates the network by the errors of new tracks.

        Its results are "reward", the negative mean error (m) of corrected tracks, and "smoothed_m",
        the mean error before the correction.
        """
        hyper = replace(self.hyper, random_share=0.0)
        lots = list(SmoothedData(self.judged, hyper, TUNING_SEED).lots())

        @torch.no_grad()
        def examine(_: Path) -> Json:
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
