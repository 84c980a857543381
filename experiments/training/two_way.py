"""Training of the two-way corrector, which corrects smoothed tracks.

The network learns from the same kinds of episodes as a corrector, but after smoothing, and it reads
every track forwards and backwards. Smoothing takes longer than learning, so all episodes are played
first; then the network learns from each of them several times.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.console.options import TUNING_SEED
from experiments.console.progress import progress, say
from experiments.console.provenance import versions_of
from experiments.evaluation.seeds import SEEDS_EACH, TRAINING_SEED
from experiments.training.corrector import CorrectorNetwork, Learner
from experiments.training.corrector_data import CorrectorData, Lot, lot_of
from experiments.training.hyperparameters import CorrectorHyperparameters
from experiments.training.levels import task_of_correctors
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.engines.play import play
from mmwave_env.engines.smoothed_features import GATES, smoothed_features
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.mode_smoothing import smooth_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import observation_columns
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.interface.signed import after_update
from mmwave_env.io.files import Json
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import blank_site
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import EpisodeBatch, columns_of
from policies import LearnedSwitch
from policies.policy_file import Card, to_bytes

SEED = TRAINING_SEED + 8 * SEEDS_EACH  # seed of episodes that no shipped network was trained on
# number of rounds of lots to play, and of passes over all these lots
ROUNDS = 16
PASSES = 8
TOGETHER = 18  # number of lots whose episodes are mixed
PARTS = ("x", "error", "mixture", *(f"memory.{gate}" for gate in GATES))


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
    actions = _actions(batch, bank, base)
    of = run_imm(bank, TrackingReward(), batch, *PARTS, actions=actions)
    hz_per_mps = float(unflatten(blank_site(batch.layout), iter(batch.site[0])).hz_per_mps)
    dt = batch.table[:, :, at.dt]
    spread_hz = batch.table[:, :, at.doppler_spread_hz]
    x, P = smooth_modes(bank, pipeline, of["mixture"], dt, spread_hz, hz_per_mps)
    gates = [of[f"memory.{gate}"] for gate in GATES]
    features = smoothed_features(pipeline, batch, x, P, of["mixture"], gates)
    return Smoothed(features, x, P, of["error"] + (x - of["x"])[..., :3])


def _actions(batch: EpisodeBatch, bank: Bank, base: str) -> Index:
    """Return the actions (n, T) of a policy."""
    n, epochs, _ = batch.table.shape
    engine = Engine(Pipeline(bank.modes, batch.layout), n, TrackingReward(), "full", bank)
    engine.batch.load(batch)
    return play(engine, LearnedSwitch(base, engine.observation), epochs).actions


class SmoothedData(CorrectorData):
    """A source of lots of smoothed tracks, with their features, errors and deviations."""

    def _play(self, batch: EpisodeBatch, bank: Bank) -> Lot:
        track = smoothed(batch, bank, self._hyper.base)
        x = np.swapaxes(track.x, 0, 1)
        P = np.swapaxes(track.P, 0, 1)
        error = np.swapaxes(track.error, 0, 1)
        return lot_of(np.swapaxes(track.features, 0, 1), x, P, error)


def trained_two_way(command: str, rounds: int = ROUNDS, passes: int = PASSES) -> bytes:
    """Train a two-way corrector; print how good it is on tuning seeds; return its policy file.

    Args:
        command: command line to state in the file.
        rounds: number of rounds of lots to play, half a million epochs each.
        passes: number of passes over all lots.
    """
    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    task, hyper = task_of_correctors()
    data = SmoothedData(task, hyper, SEED)
    lots = []
    with progress("playing") as report:
        for i in range(rounds):
            lots += list(data.lots())
            report((i + 1) / rounds)
    learner = learned_from(lots, hyper, passes)
    held = list(SmoothedData(task, hyper, TUNING_SEED).lots())
    evaluation = {str(p): _figures(learner, lot) for p, lot in zip(task.places, held, strict=False)}
    pipeline = Pipeline(task.bank.modes, Layout())
    card = Card(
        modes=task.bank.modes,
        observation="signed",
        features=observation_columns(after_update(pipeline, per_mode=True)),
        scenario=task.scenario,
        radio=", ".join(task.banks),
        algorithm=hyper.algorithm,
        seed=SEED,
        timesteps=sum(lot.features[..., 0].size for lot in lots),
        command=command,
        evaluation=evaluation,
        versions=versions_of("gymnasium", "numpy", "numba", "torch"),
        beliefs="per-mode",
        banks=dict(task.banks),
        base=hyper.base,
    )
    return to_bytes(learner.tensors(), card)


def learned_from(lots: Sequence[Lot], hyper: CorrectorHyperparameters, passes: int) -> Learner:
    """Return a learner whose network learned from all lots, ``passes`` times."""
    learner = Learner(CorrectorNetwork(lots[0].features.shape[-1], hyper, two_way=True), hyper)
    learner.measure(list(lots[: 4 * TOGETHER]))
    groups = -(-len(lots) // TOGETHER)
    with progress("learning") as report:
        for i in range(passes):
            rng = np.random.default_rng((SEED, i))
            for j, some in enumerate(np.array_split(rng.permutation(len(lots)), groups)):
                done = (i + j / groups) / passes
                learner.learn([lots[k] for k in some], 1.0 - done, rng)
                report(done)
    return learner


def _figures(learner: Learner, lot: Lot) -> Json:
    """Return the mean error (m) of smoothed tracks, before and after correction."""
    with torch.no_grad():
        shift = learner.answer(lot)[0].mean(dim=2).numpy()
    before = _mean_length(lot.error)
    after = _mean_length(lot.error - shift * lot.deviation)
    say(f"error of smoothed tracks: {before:.4f} m, corrected: {after:.4f} m")
    return {"smoothed_m": before, "corrected_m": after}


def _mean_length(error: NDArray[Any]) -> float:
    """Return the mean length of errors (T, n, 3) in scored epochs."""
    return float(np.linalg.norm(error[BURN_IN:], axis=-1).mean())
