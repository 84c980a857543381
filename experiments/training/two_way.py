"""Training of the two-way corrector, which corrects smoothed tracks.

The network learns from the same kinds of episodes as a corrector, but after smoothing, and it reads
every track forwards and backwards. Smoothing takes longer than learning, so all episodes are played
first; then the network learns from each of them several times.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.console.options import TUNING_SEED
from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import run_contender
from experiments.training.corrector import CorrectorTrainer
from experiments.training.corrector_data import CorrectorData, Lot, base_policy, lot_of
from experiments.training.hyperparameters import TwoWayHyperparameters
from mmwave_env.engines.smoothed_features import GATES, smoothed_features
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.io.files import Json
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.numbers import Array, Array32
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import EpisodeBatch, columns_of

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
    of = run_contender(contender, contender.start(batch.layout), batch, after=PARTS)
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
            order = rng.permutation(len(lots))
            for some in np.array_split(order, -(-len(lots) // TOGETHER)):
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
