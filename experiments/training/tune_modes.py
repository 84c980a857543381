"""Tuning of modes' process noise: the likelihood to maximize, and the search."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from experiments.console.options import TuneArgs, WorldArgs
from experiments.console.progress import say, tracked
from experiments.evaluation.contenders import draw_episodes, source_of
from experiments.evaluation.intervals import bootstrap
from mmwave_env.engines.engine import tracks_of
from mmwave_env.filters.bank import as_written, modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.io.files import Json
from mmwave_env.io.lookup import choose
from mmwave_env.metrics import scored
from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import radio_from
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode

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
    rows = [group.stop - group.start for group in layout.groups]
    excess = np.maximum(nis - chdtri(rows, 1.0 - CAP), 0.0).sum(axis=-1)
    capped = log_likelihood + 0.5 * excess
    per_epoch: Array = capped[:, scored(nis.shape[1])].mean(axis=-1)
    return per_epoch


def objective_of(mode: Mode, episodes: Sequence[Episode]) -> Objective:
    """Return a function that maps a variant of ``mode`` to likelihoods (episodes,) of episodes."""
    layout = episodes[0].layout
    tracker = tracks_of(Pipeline((mode,), layout), len(episodes))
    tracker.load(episodes)

    def evaluate(tried: Mode) -> Array:
        tracker.tune([tried.tuning])
        return likelihood(tracker.run("memory.nis", "log_likelihood"), layout)

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


def tuned_modes(args: TuneArgs) -> tuple[Json, Json]:
    """Tune and print modes one by one; return the mode file's content, and results for --json."""
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
    figures = []
    title = "log-likelihood per epoch"
    for mode, scenario in zip(modes, args.scenarios, strict=True):
        source = source_of(WorldArgs(scenario=scenario, radio=args.radio))
        episodes = draw_episodes(source, range(args.seed, args.seed + args.episodes))
        started = replace(mode, coupling=mode.coupling and not args.diagonal)
        objective = objective_of(started, episodes)
        best = tune(started, args.free, objective)
        tuned.append(as_written(best))
        (value,) = bootstrap(objective(best)[:, None])
        numbers = ", ".join(f"{name} {getattr(best, name):g}" for name in args.free)
        say(f"{mode.name} on {source.name}, {radio.name}: {numbers}: {title} {value}")
        figures.append({"mode": mode.name, "scenario": scenario, "objective": title} | value.json)
    return {"modes": tuned}, {"tuned": figures}
