"""Tuning of the bank of the policy `imm-best`: an IMM's modes and transition probabilities.

The modes of this bank are for users who stand, cruise, turn, accelerate or brake. All parameters
are tuned together. They maximize the mean reward over all training scenes and two rates of epochs.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.special import softmax

from experiments.console.options import WorldArgs
from experiments.console.progress import progress, say
from experiments.evaluation.contenders import draw_episodes, source_of
from experiments.evaluation.intervals import bootstrap
from mmwave_env.engines.engine import run_imm
from mmwave_env.filters.bank import Bank, bank_as_written, default_modes
from mmwave_env.filters.imm import DEFAULT_STAY
from mmwave_env.filters.modes import Mode
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.io.files import Json
from mmwave_env.io.lookup import require_extra
from mmwave_env.metrics import DIVERGENCE_M, scored
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import TRAINED_SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import EpisodeBatch, EpisodeSource

STEPS_S = (1.0, 0.1)  # times between two epochs, s
SHARES = 3  # number of parts of the tuning episodes; the search's generations use them in turn
# Modes for steady motion have gates, which reject improbable measurements as outliers. The other
# modes inflate the noise of such a measurement instead, since the cause may be a maneuver.
_STEADY: dict[str, Any] = {"sigma_p": 0.01, "adaptive": False, "blockage_aware": True}
_LIVELY: dict[str, Any] = _STEADY | {"robust": True}
START = (
    Mode("stand", "ekf", sigma_v=0.05, **_STEADY),
    Mode("cruise", "ukf", sigma_v=0.5, **_STEADY),
    Mode("turn", "ukf", sigma_v=1.9, **_LIVELY),
    Mode("accelerate", "ukf", sigma_v=0.3, acceleration_mps2=2.0, **_LIVELY),
    Mode("brake", "ukf", sigma_v=0.2, acceleration_mps2=-2.0, **_LIVELY),
)


def tuned_bank(radio: str, episodes: int, seed: int, evaluations: int) -> Json:
    """Search for a radio's best bank; print its reward; return its mode file, with results.

    Args:
        radio: radio profile, a name or a JSON file.
        episodes: number of episodes to tune on, divided equally among scenes and rates; the same
            number of episodes with the following seeds measures the result.
        seed: seed of the first episode.
        evaluations: maximum number of banks that the search evaluates.

    Raises:
        ValueError: there are too few episodes.
        MissingExtraError: the extra "tune" is not installed.
    """
    require_extra("cmaes", "tune", "tune --bank")
    sources = [
        source_of(WorldArgs(radio=radio, scene=scene, dt=dt))
        for scene in TRAINED_SCENES
        for dt in STEPS_S
    ]
    each = episodes // len(sources)
    shares = drawn(sources, range(seed, seed + each), SHARES)
    (held_out,) = drawn(sources, range(seed + each, seed + 2 * each))
    space = search_space(START)

    def value(bank: Bank, generation: int) -> float:
        reward, _ = scores(bank, shares[generation % SHARES])
        return float(reward.mean())

    began = process_time()
    with progress("bank"):
        bank = best_bank_of(space, value, evaluations)
    seconds = round(process_time() - began)
    reward, lost = scores(bank, held_out)
    imm_reward, _ = scores(Bank(default_modes(radio_from(radio).base)), held_out)
    columns = {"reward": reward, "minus imm": reward - imm_reward, "lost": lost}
    figures = bootstrap(np.stack([*columns.values()], axis=1))
    say(
        f"{radio_from(radio).name}, on new episodes (as many as for tuning): reward {figures[0]}, "
        f"gain over imm {figures[1]}"
    )
    return bank_as_written(bank) | {
        "numbers": len(space.start),
        "seconds": seconds,
        "held_out": {k: mean.json for k, mean in zip(columns, figures, strict=True)},
    }


def drawn(
    sources: Sequence[EpisodeSource], seeds: range, shares: int = 1
) -> list[list[EpisodeBatch]]:
    """Draw episodes and split them into equal parts; each part has one batch per source, in order.

    Raises:
        ValueError: there are fewer seeds than parts (``shares``).
    """
    if len(seeds) < shares:
        raise ValueError(
            f"episodes: found {len(seeds)} for each scene and step, expected {shares} or more, "
            f"{shares * len(sources)} in total"
        )
    episodes = [draw_episodes(source, seeds) for source in sources]
    return [[EpisodeBatch.of(some[share::shares]) for some in episodes] for share in range(shares)]


def scores(bank: Bank, batches: Sequence[EpisodeBatch]) -> tuple[Array, Array]:
    """Run the IMM of a bank on all episodes, batch after batch.

    Returns:
        First, (n,) the mean reward of each episode's scored epochs. Second, (n,) 1 if the estimate
        in the last epoch is farther than DIVERGENCE_M from the true position, else 0.
    """
    reward = []
    lost = []
    for batch in batches:
        results = run_imm(bank, TrackingReward(), batch, "reward", "error")
        counted = scored(results["reward"].shape[1])
        reward.append(results["reward"][:, counted].mean(axis=1))
        lost.append(np.linalg.norm(results["error"][:, -1], axis=1) > DIVERGENCE_M)
    return np.concatenate(reward), np.concatenate(lost).astype(float)


# --- the search

SEED = 0  # seed of the search

# Ranges to search:
ODDS = (-14.0, 8.0)  # log(probability to change to another mode / probability to stay)
# A sigma_v below 0.04 would earn a slightly higher reward, because simulated users walk straight.
# But it would lose real users, whose direction varies by a few degrees.
FREE = {
    "sigma_p": (0.005, 2.0),
    "sigma_v": (0.04, 6.0),
    "acceleration_mps2": (0.3, 6.0),
    "turn_rate_radps": (0.02, 1.0),
}
NINES = (1.0, 9.0)  # number of nines of the quantile that caps the NIS: 3 nines are 0.999
DECIMALS = 6  # decimals of probabilities

# Standard deviations of the first generation's log odds, logs of FREE parameters, and nines:
_PROBABILITY_STEP = 0.6
_NOISE_STEP = 0.25
_NINES_STEP = 0.3


class SearchSpace(NamedTuple):
    """A space to search: each point (k,) determines a bank."""

    start: Array  # (k,) center of the first points
    deviation: Array  # (k,) standard deviations of the first points
    bounds: Array  # (k, 2) lowest and highest values
    bank_at: Callable[[Array], Bank]  # bank at a point, rounded as in a file


def search_space(modes: Sequence[Mode]) -> SearchSpace:
    """Return the search space of transition probabilities, noise, maneuvers and NIS quantile."""
    n = len(modes)
    first = n * (n - 1)  # number of odds, which come first in a point
    change = np.log((1.0 - DEFAULT_STAY) / (n - 1) / DEFAULT_STAY)
    free = [(i, field) for i, field in product(range(n), FREE) if getattr(modes[i], field)]
    noise = [np.log(abs(getattr(modes[i], field))) for i, field in free]

    def bank_at(point: Array) -> Bank:
        logits = np.zeros((n, n))
        logits[~np.eye(n, dtype=bool)] = point[:first]  # log(p_ij / p_ii), row by row
        tuned = list(modes)
        for (i, field), size in zip(free, np.exp(point[first:-1]), strict=True):
            value: Any = float(np.copysign(float(f"{size:.3g}"), getattr(modes[i], field)))
            tuned[i] = replace(tuned[i], **{field: value})
        return Bank(
            tuple(tuned),
            _written(softmax(logits, axis=1)),
            1.0 - float(f"{10.0 ** -point[-1]:.2g}"),
        )

    return SearchSpace(
        np.array([*[change] * first, *noise, 3.0]),
        np.repeat([_PROBABILITY_STEP, _NOISE_STEP, _NINES_STEP], [first, len(free), 1]),
        np.array([*[ODDS] * first, *(np.log(FREE[field]) for _, field in free), NINES]),
        bank_at,
    )


def _written(transition: Array) -> tuple[tuple[float, ...], ...]:
    """Round probabilities to DECIMALS decimals so that rows still sum to 1."""
    short = transition.round(DECIMALS)
    np.fill_diagonal(short, 0.0)
    np.fill_diagonal(short, (1.0 - short.sum(axis=1)).round(DECIMALS))
    return tuple(map(tuple, short.tolist()))


def best_bank_of(space: SearchSpace, value: Callable[[Bank, int], float], evaluations: int) -> Bank:
    """Return the bank at the mean of the search's centers in the second half of the search.

    Points are compared only within a generation, so each generation may have its own episodes. The
    center of the search then wanders around the optimum for all episodes, and the mean of the
    centers is closer to the optimum than the last center (Polyak and Juditsky 1992).

    Args:
        space: space to search.
        value: function to maximize; its arguments are a bank and the number of the generation.
        evaluations: maximum number of calls of ``value``; if one generation needs more calls, the
            start is returned.
    """
    from cmaes import CMA  # needs the extra "tune"

    first = np.diag(np.square(space.deviation))
    optimizer = CMA(space.start, 1.0, bounds=space.bounds, seed=SEED, cov=first)
    centers = [space.start]
    for generation in range(evaluations // optimizer.population_size):
        points = [optimizer.ask() for _ in range(optimizer.population_size)]
        optimizer.tell([(point, -value(space.bank_at(point), generation)) for point in points])
        centers.append(optimizer.mean.copy())
    return space.bank_at(np.mean(centers[len(centers) // 2 :], axis=0))
