"""Tuning of modes and of banks, for the command ``tune``.

Modes are tuned one by one: their process noise maximizes the likelihood of measurements. The bank
of the policy `imm-best` has modes for users who stand, cruise, turn, accelerate or brake. All its
parameters, with the probabilities of changes between modes, are tuned together. They maximize the
mean reward of the IMM over all training scenes and two rates of epochs.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri, softmax

from experiments.console.options import TuneArgs, WorldArgs
from experiments.console.output import progress, say, tracked
from experiments.evaluation.contenders import draw_episodes, source_of
from experiments.evaluation.intervals import bootstrap
from mmwave_env.engines.engine import run_imm, tracker_of
from mmwave_env.filters.bank import Bank, as_written, bank_as_written, default_modes, modes_from
from mmwave_env.filters.imm import DEFAULT_STAY
from mmwave_env.filters.modes import Mode
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.io.files import Json
from mmwave_env.io.lookup import choose, require_extra
from mmwave_env.metrics import scored
from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import TRAINED_SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode, EpisodeBatch, EpisodeSource

Objective = Callable[[Mode], Array]

# Range to search for each part of the process noise, in the units of Mode.
RANGES = {
    "sigma_p": (0.01, 2.0),
    "sigma_v": (0.1, 4.0),
    "sigma_pz": (0.001, 0.2),
    "sigma_vz": (0.001, 0.2),
    "sigma_b_mps": (0.01, 0.5),
    "spread_gain": (1e-4, 0.1),
}
# Likelihoods cap the NIS at this chi-square quantile. On data simulated with the filter's own
# model, a cap at 0.99 would bias sigma_v by -6 %, a cap at 0.999 by less than 1 %.
CAP = 0.999
POINTS = (11, 6)  # numbers of grid points for the first and the second parameter
STEP = 0.3  # size of the first simplex, in logarithms: each parameter changes by about a third


def likelihood(history: dict[str, Array], layout: Layout) -> Array:
    """Return each episode's mean log-likelihood per epoch (episodes,), with outliers capped.

    Without the cap, unmodeled blockage would dominate. The constant -(n / 2) log(2 pi) of n
    measured values is left out.
    """
    nis = history["memory.nis"]
    log_likelihood = history["log_likelihood"]
    excess = np.maximum(nis - chdtri(layout.widths, 1.0 - CAP), 0.0).sum(axis=-1)
    capped = log_likelihood + 0.5 * excess
    per_epoch: Array = capped[:, scored(nis.shape[1])].mean(axis=-1)
    return per_epoch


def objective_of(mode: Mode, episodes: Sequence[Episode]) -> Objective:
    """Return a function that maps a variant of ``mode`` to likelihoods (episodes,) of episodes."""
    tracker = tracker_of(mode, episodes)

    def evaluate(tried: Mode) -> Array:
        tracker.tune([tried.tuning])
        return likelihood(tracker.run("memory.nis", "log_likelihood"), tracker.layout)

    return evaluate


def tune(mode: Mode, free: Sequence[str], objective: Objective) -> Mode:
    """Return the mode with the best values of its free parameters.

    A Nelder-Mead search over all free parameters starts at the best point of a logarithmic grid
    over the first two of them.
    """
    bounds = np.log([RANGES[name] for name in free])

    def at(values: Iterable[float]) -> Mode:
        return replace(mode, **{k: float(v) for k, v in zip(free, values, strict=False)})  # type: ignore[arg-type]

    def loss(logarithms: Sequence[float]) -> float:
        return -float(np.nan_to_num(objective(at(np.exp(logarithms))).mean(), nan=-np.inf))

    axes = [np.linspace(a, b, n) for (a, b), n in zip(bounds.tolist(), POINTS, strict=False)]
    best = at(np.exp(min(tracked([*product(*axes)], mode.name), key=loss)))
    start = np.log([max(getattr(best, name), 1e-12) for name in free])
    corner = np.clip(start, *(bounds.T + [[0.0], [-STEP]]))
    optimum = minimize(
        loss,
        corner,
        method="Nelder-Mead",
        bounds=bounds,
        options={
            "initial_simplex": corner + STEP * np.eye(len(free) + 1, len(free), k=-1),
            "xatol": 0.005,
            "fatol": 1e-5,
        },
    )
    return at([float(f"{value:.3g}") for value in np.exp(optimum.x)])


def tuned_modes(args: TuneArgs) -> Json:
    """Tune and print modes one by one; return the mode file's content."""
    radio = radio_from(args.radio)
    modes = modes_from(args.modes, radio.base)  # named modes have tunings for shipped radios
    if len(args.scenarios) != len(modes):
        raise ValueError(
            f"scenarios: found {len(args.scenarios)}, expected {len(modes)}, one for each of the "
            f"modes {', '.join(mode.name for mode in modes)}"
        )
    if not args.free or len(set(args.free)) < len(args.free):
        raise ValueError(f"free: found {args.free}, expected one or more different names")
    for name in args.free:
        choose(RANGES, name, "free")
    tuned = []
    for mode, scenario in zip(modes, args.scenarios, strict=True):
        source = source_of(WorldArgs(scenario=scenario, radio=args.radio))
        episodes = draw_episodes(source, range(args.seed, args.seed + args.episodes))
        started = replace(mode, coupling=mode.coupling and not args.diagonal)
        objective = objective_of(started, episodes)
        best = tune(started, args.free, objective)
        tuned.append(as_written(best))
        (value,) = bootstrap([objective(best)])
        numbers = ", ".join(f"{name} {getattr(best, name):g}" for name in args.free)
        say(
            f"{mode.name} on {source.name}, {radio.name}: {numbers}: "
            f"log-likelihood per epoch {value}"
        )
    return {"modes": tuned}


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


def tuned_bank(args: TuneArgs) -> Json:
    """Search for a radio's best bank; print its reward; return its mode file, with results.

    The episodes are divided equally among scenes and rates. As many episodes, with the following
    seeds, measure the result.

    Raises:
        ValueError: there are too few episodes.
        MissingExtraError: the extra "tune" is not installed.
    """
    require_extra("cmaes", "tune", "tune --bank")
    sources = [
        source_of(WorldArgs(radio=args.radio, scene=scene, dt=dt))
        for scene in TRAINED_SCENES
        for dt in STEPS_S
    ]
    each = args.episodes // len(sources)
    middle = args.seed + each
    shares = drawn(sources, range(args.seed, middle), SHARES)
    (held_out,) = drawn(sources, range(middle, middle + each))
    space = search_space(START)

    def value(bank: Bank, generation: int) -> float:
        return float(rewards(bank, shares[generation % SHARES]).mean())

    with progress("bank"):
        bank = best_bank_of(space, value, args.evaluations)
    reward = rewards(bank, held_out)
    radio = radio_from(args.radio)
    imm_reward = rewards(Bank(default_modes(radio.base)), held_out)
    own, gain = bootstrap([reward, reward - imm_reward])
    say(
        f"{radio.name}, on new episodes (as many as for tuning): reward {own}, gain over imm {gain}"
    )
    return bank_as_written(bank) | {"held_out": {"reward": own.json, "minus imm": gain.json}}


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


def rewards(bank: Bank, batches: Sequence[EpisodeBatch]) -> Array:
    """Return each episode's mean reward (n,) if the IMM of a bank runs, batch after batch."""
    means = []
    for batch in batches:
        reward = run_imm(bank, TrackingReward(), batch, "reward")["reward"]
        means.append(reward[:, scored(reward.shape[1])].mean(axis=1))
    return np.concatenate(means)


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
    rows = [(change, _PROBABILITY_STEP, *ODDS)] * first
    for i, field in free:
        rows.append((np.log(abs(getattr(modes[i], field))), _NOISE_STEP, *np.log(FREE[field])))
    rows.append((3.0, _NINES_STEP, *NINES))
    table = np.array(rows)

    def bank_at(point: Array) -> Bank:
        logits = np.zeros((n, n))
        logits[~np.eye(n, dtype=bool)] = point[:first]  # log(p_ij / p_ii), row by row
        tuned = list(modes)
        for (i, field), size in zip(free, np.exp(point[first:-1]), strict=True):
            value: Any = float(np.copysign(float(f"{size:.3g}"), getattr(modes[i], field)))
            tuned[i] = replace(tuned[i], **{field: value})
        transition = softmax(logits, axis=1).round(DECIMALS)
        np.fill_diagonal(transition, 0.0)  # then rows of rounded probabilities still sum to 1
        np.fill_diagonal(transition, (1.0 - transition.sum(axis=1)).round(DECIMALS))
        rows = tuple(map(tuple, transition.tolist()))
        return Bank(tuple(tuned), rows, 1.0 - float(f"{10.0 ** -point[-1]:.2g}"))

    return SearchSpace(table[:, 0], table[:, 1], table[:, 2:], bank_at)


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
