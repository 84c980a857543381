"""mmwave-loc tune-imm: the strongest IMMs over given modes, on tuning seeds."""

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from rich.console import Console
from scipy.optimize import minimize
from scipy.special import expit, logit, softmax

from experiments.arguments.shared import WorldArgs
from experiments.arguments.tune_imm import Args
from experiments.cli.main import run
from experiments.cli.options import command_line, source_of
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.seeds import draw_episodes, require_tuning_seed
from experiments.tune import CAP
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.episodes.episode import EpisodeBatch
from mmwave_env.files import write_json
from mmwave_env.filters.imm import DEFAULT_STAY
from mmwave_env.filters.mode_files import as_written, modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.lookup import choose
from mmwave_env.metrics import scored
from mmwave_env.numerics.arrays import Array
from mmwave_env.reward import TrackingReward
from policies import TUNED_IMMS

Build = Callable[[Array], tuple[tuple[Mode, ...], Array]]

STAY = (-6.0, 9.0)  # log odds to stay, where they are looked for
ENTER = (-20.0, 20.0)  # log probability to be entered, over that of the last mode
NOISE = {"sigma_p": (0.005, 2.0), "sigma_v": (0.03, 4.0)}  # as tune's RANGES, but lower


def transition_of(stay: Array, enter: Array) -> Array:
    """Transition probabilities (from, to): a mode is left for the others in fixed proportions.

    p_ij = (1 - s_i) q_j / sum of q_k over k != i, and p_ii = s_i.

    Args:
        stay: (modes,) log odds of s.
        enter: (modes,) log q, up to a constant.
    """
    s, modes = expit(stay), len(stay)
    others = np.where(np.eye(modes, dtype=bool), -np.inf, enter)
    transition: Array = np.diag(s) + (1.0 - s)[:, None] * softmax(others, axis=1)
    return transition


def search_space(modes: tuple[Mode, ...], noise: bool) -> tuple[Array, Array, Build]:
    """Where to search: the start (k,), the bounds (k, 2), and what a point stands for.

    Args:
        modes: to begin with.
        noise: of two modes the process noise is free, too. More than two differ in it on
            purpose.
    """
    n = len(modes)
    entered = n - 1 if n > 2 else 0  # of two modes, the other one is entered
    noisy = [(i, name) for i in range(n) for name in NOISE] if noise and n == 2 else []
    start = [logit(DEFAULT_STAY)] * n + [0.0] * entered
    start += [np.log(getattr(modes[i], name)) for i, name in noisy]
    bounds = [STAY] * n + [ENTER] * entered + [tuple(np.log(NOISE[name])) for _, name in noisy]

    def build(point: Array) -> tuple[tuple[Mode, ...], Array]:
        enter = np.zeros(n)
        enter[:entered] = point[n : n + entered]
        found = list(modes)
        for (i, name), value in zip(noisy, point[n + entered :], strict=True):
            figure = float(f"{np.exp(value):.3g}")
            found[i] = replace(found[i], **{name: figure})  # type: ignore[arg-type]
        return tuple(found), transition_of(point[:n], enter)

    return np.clip(start, *np.transpose(bounds)), np.array(bounds), build


def rewards(modes: tuple[Mode, ...], transition: Array | None, q: float, on: EpisodeBatch) -> Array:
    """Mean reward (episodes,) of an IMM."""
    imm = ImmEngine(Pipeline(modes, on.layout), TrackingReward(), transition, q)
    earned = imm.run(on, "reward")["reward"]
    return earned[:, scored(earned.shape[1])].mean(axis=1)  # type: ignore[no-any-return]


def tune(
    modes: tuple[Mode, ...], limited: bool, episodes: EpisodeBatch, evaluations: int
) -> tuple[tuple[Mode, ...], Array]:
    """The modes and the transition of the best IMM that Powell's method finds.

    The reward has small steps, where a link passes a gate or does not, so no gradients.
    """
    start, bounds, build = search_space(modes, limited)
    found = minimize(
        lambda point: -rewards(*build(point), quantile(limited), episodes).mean(),
        start,
        method="Powell",
        bounds=bounds,
        options={"xtol": 0.02, "ftol": 1e-5, "maxfev": evaluations},
    )
    return build(found.x)


def quantile(limited: bool) -> float:
    """Up to which NIS counts in the likelihoods."""
    return CAP if limited else 1.0


def tuned(args: Args, radio: str, name: str) -> dict[str, Any]:
    """An IMM as the shipped file holds it; its gains are over where the tuning started."""
    source = source_of(WorldArgs(scenario=args.scenario, radio=radio))
    first, bank = args.seed + args.episodes, TUNED_IMMS[name]
    tuning, held_out = (
        EpisodeBatch.of(draw_episodes(source, seeds))
        for seeds in (range(args.seed, first), range(first, first + args.held_out))
    )
    started, q = modes_from(bank.modes, radio), quantile(bank.limited)
    with Console(stderr=True).status(f"{name}, {radio}"):
        modes, transition = tune(started, bank.limited, tuning, args.evaluations)
    found: dict[str, Interval] = {}
    for prefix, episodes in (("", tuning), ("held_out_", held_out)):
        reward = rewards(modes, transition, q, episodes)
        gain = reward - rewards(started, None, 1.0, episodes)
        pair = bootstrap(np.stack([reward, gain], axis=1))
        found[f"{prefix}reward"], found[f"{prefix}gain"] = pair
    print(f"{radio} {name}: reward {found['reward']}, gain {found['gain']}; held out "
          f"{found['held_out_reward']}, gain {found['held_out_gain']}", flush=True)  # fmt: skip
    return {
        "command": command_line(
            "tune-imm", replace(args, radios=(radio,), imms=(name,), json=None)
        ),
        "modes": [as_written(mode) for mode in modes],
        "transition": transition.tolist(),
        "nis_quantile": q,
        **{what: interval.json for what, interval in found.items()},
    }


def main(args: Args) -> None:
    """Run the command."""
    require_tuning_seed(args.seed)
    for name in args.imms:
        choose(TUNED_IMMS, name, "imms")
    found: dict[str, Any] = {}
    if args.json and args.json.is_file():
        found = json.loads(args.json.read_text(encoding="utf-8"))
    for radio in args.radios:
        for name in args.imms:
            found.setdefault(radio, {})[name] = tuned(args, radio, name)
            if args.json:
                write_json(args.json, found)


if __name__ == "__main__":
    run("tune-imm")
