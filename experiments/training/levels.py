"""Training and calibration of protection levels (:mod:`mmwave_env.localization.levels`).

A protection level is a bound that a position error exceeds with a given probability, the risk. The
Gaussian level is this bound if errors are Gaussian with the belief's covariance. A network learns
quantiles of log(error / Gaussian level), by the pinball loss, from the same kinds of episodes as
correctors of beliefs. Constants, calibrated on other episodes, are added to the network's outputs.
"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from experiments.console.options import SEEDS_EACH, TRAINING_SEED
from experiments.evaluation.contenders import contender_from
from experiments.evaluation.runner import run_contender
from experiments.training.corrector import normalization_of
from experiments.training.corrector_data import Surveys, TrainingEpisodes
from experiments.training.networks import perceptron
from experiments.training.training_task import places_from
from mmwave_env.localization.levels import GAUSSIAN, PARTS, Levels, Network
from mmwave_env.localization.position_errors import error_sizes, gaussian_levels
from mmwave_env.models.radio import TUNED_RADIOS
from mmwave_env.models.random_scene import RandomSurvey
from mmwave_env.models.scene import TRAINED_SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import columns_of
from policies.sb3 import actor_tensors

RISKS = (1e-2, 1e-3)
SINGLE = ("speed-rule", "fixed-ekf", "fixed-ukf")  # policies that run one filter at a time
# LEARNED_FROM: groups of policies that play the training episodes. KINDS: groups for calibration.
# Each batch of episodes is played once for every group, by a random policy of the group.
LEARNED_FROM = (("guided",), ("corrector",), ("imm-best", "imm", *SINGLE))
KINDS = (SINGLE, ("guided", "imm-best"), ("corrector",))
PLACES = [f"{scene}:{radio}" for scene in TRAINED_SCENES for radio in TUNED_RADIOS]
SEED = TRAINING_SEED + 9 * SEEDS_EACH  # seed of episodes that no corrector was trained on
# ENVS: episodes per place in a round. ROUNDS: training rounds. CALIBRATION: calibration rounds.
# RANDOM_SHARE: share of random episodes among the training episodes.
ENVS = 64
LONG_EPOCHS = 400  # length of long episodes, epochs
RANDOM_SHARE = 0.5
ROUNDS = 48
CALIBRATION = 30
# the learning rate falls linearly to 0
HIDDEN = 64
STEPS = 6000
BATCH = 8192
RATE = 3e-3
EVERY = 4  # neighboring epochs are alike, so the network learns from one epoch in four
# What a careful survey leaves: up to about 0.5 degrees and 0.3 m, two standard deviations. Half
# of the lots have it, the others no error.
CAREFUL = RandomSurvey(
    rate=1.0,
    rotation_rad=math.radians(0.25),
    tilt_rad=math.radians(0.25),
    range_m=0.15,
    anchors_m=0.15,
    heights_m=0.15,
    slow=0.0,
)
CAREFUL_SURVEYS = Surveys(0.5, 0.5, CAREFUL, CAREFUL, 0.0)
LEAST_M = 1e-4  # smaller errors count as 0.1 mm
# largest finite constant; number of bisection steps to find a constant
LIMIT = 8.0
HALVINGS = 24


def _played(
    seed: int, rounds: int, policies: Sequence[tuple[str, ...]], random_share: float
) -> Iterator[tuple[Array, Array]]:
    """Yield features and logs for each batch of episodes and each group of policies.

    The features are (n, T, features). The logs (n, T, risks, 2) are logarithms of the horizontal
    and the vertical error, each divided by its Gaussian level. The episodes are drawn as for a
    corrector; ``random_share`` is the share of random episodes.
    """
    episodes = TrainingEpisodes(
        "mixed", places_from(PLACES), seed, ENVS, random_share, LONG_EPOCHS, CAREFUL_SURVEYS
    )
    rng = np.random.default_rng(seed)
    for radio, batch in episodes.batches(rounds):
        time_s = batch.table[0, :, columns_of(batch.layout).dt].cumsum()
        for names in policies:
            contender = contender_from(str(rng.choice(names)), radio)
            of = run_contender(contender, batch, after=PARTS)
            features = Levels(kind=GAUSSIAN).features(
                batch.layout.anchors, contender.bank is not None, time_s, of
            )
            levels = np.stack([gaussian_levels(of["P"], risk) for risk in RISKS], axis=-2)
            ratio = np.maximum(error_sizes(of["error"]), LEAST_M)[..., None, :] / levels
            yield features.astype(np.float32), np.log(ratio).astype(np.float32)


def _finite(lot: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the finite rows (epochs, ...) of one epoch in EVERY of a lot (n, T, ...)."""
    features = np.concatenate(lot[0][:, ::EVERY])
    logs = np.concatenate(lot[1][:, ::EVERY])
    finite = np.isfinite(features).all(axis=1) & np.isfinite(logs).all(axis=(1, 2))
    return features[finite], logs[finite]


def _trained(features: Array, logs: Array, steps: int) -> Network:
    """Train a network to predict quantiles of ``logs`` (n, risks, 2); leave its constants at 0."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    normal = normalization_of(features[::16].astype(float))
    x = torch.from_numpy(normal.normalized(features))
    y = torch.from_numpy(logs)
    risk = torch.tensor(RISKS)[:, None]
    network = perceptron(x.shape[1], HIDDEN, HIDDEN, 2 * len(RISKS))
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = RATE * (1.0 - step / steps)
        rows = torch.randint(len(x), (BATCH,))
        above = y[rows] - network(x[rows]).unflatten(-1, (-1, 2))
        pinball = torch.maximum((1.0 - risk) * above, -risk * above)
        loss = (pinball / risk.sqrt()).mean()  # the divisor gives both risks a similar weight
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    actor = actor_tensors(network, normal)
    tensors = {name: tensor.astype(float) for name, tensor in actor.items()}
    return Network([*RISKS], tensors | {"constants": np.zeros((len(KINDS), len(RISKS), 2))})


def _constants(network: Network, seed: int, rounds: int) -> Array:
    """Return the constants (kinds, risks, 2) of the calibration.

    The episodes of each place yield a constant. All episodes, plus one with infinite errors, yield
    another (split conformal prediction, Lee et al. 2023). The largest of these constants is used.
    """
    over: list[list[Array]] = [[] for _ in range(len(PLACES) * len(KINDS))]
    for i, (features, logs) in enumerate(_played(seed, rounds, KINDS, 0.0)):
        over[i % len(over)].append(logs - network.log_factors(features))
    constants = []
    for kind in range(len(KINDS)):
        places = over[kind :: len(KINDS)]
        pooled = _least([part for parts in places for part in parts], 1)
        constants.append(np.max([pooled, *(_least(parts, 0) for parts in places)], axis=0))
    return np.array(constants)


def _least(parts: list[Array], infinite: int) -> Array:
    """Return the least constants (risks, 2) that the logs of all parts exceed rarely enough.

    A part has logs (n, T, risks, 2). The share of epochs whose logs exceed a constant, plus the
    standard error of this share over episodes, is at most the risk. ``infinite`` is a number of
    episodes to add, whose logs are infinite. Constants above LIMIT become infinite.
    """
    high = np.full((len(RISKS), 2), LIMIT)
    low = -high
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        over = [(~(part <= middle)).mean(axis=1) for part in parts]
        shares = np.concatenate([*over, np.ones((infinite, *middle.shape))])
        bound = shares.mean(axis=0) + shares.std(axis=0) / np.sqrt(len(shares))
        low, high = np.where(bound > np.array(RISKS)[:, None], [middle, high], [low, middle])
    return np.where(high < LIMIT, high, np.inf)


def trained_levels(
    seed: int, rounds: int = ROUNDS, calibration: int = CALIBRATION, steps: int = STEPS
) -> Network:
    """Train and calibrate a network.

    ``seed`` determines only the calibration's episodes.

    The network learns from ``rounds`` rounds of episodes in ``steps`` gradient steps, and is
    calibrated on ``calibration`` rounds.
    """
    lots = [_finite(lot) for lot in _played(SEED, rounds, LEARNED_FROM, RANDOM_SHARE)]
    features, logs = zip(*lots, strict=True)
    network = _trained(np.concatenate(features), np.concatenate(logs), steps)
    network.tensors["constants"] = _constants(network, seed, calibration)
    return network
