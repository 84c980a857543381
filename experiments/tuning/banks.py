"""mmwave-loc tune-imm: the strongest IMMs over given modes, on tuning seeds."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import logit

from experiments.console.doc_pages import page_to_renew, renewed
from experiments.console.options import WorldArgs
from experiments.console.progress import progress, say
from experiments.console.provenance import command_line
from experiments.console.tables import grid, show
from experiments.evaluation.asked import source_of
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.seeds import TUNING_SEED, draw_episodes, require_tuning_seed
from experiments.tuning.designs import DESIGNS
from experiments.tuning.scores import CAP, Scores, drawn, scores
from experiments.tuning.search import best_bank_of
from experiments.tuning.search_space import ENTER, STAY, search_space, transition_of
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.files import read_json, write_json, write_text
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.imm import DEFAULT_STAY
from mmwave_env.filters.mode_files import as_written, modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.lookup import choose, quoted, require_extra
from mmwave_env.metrics import scored
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.arrays import Array
from mmwave_env.reward import TrackingReward
from mmwave_env.world.episode import EpisodeBatch
from policies import TUNED_IMMS, tuned_imm


@dataclass(kw_only=True)
class Args:
    """Tune IMMs per radio profile, by mean reward: transition and, of two modes, process noise.

    With --banks everything of a bank of modes that is data, by CMA-ES (extra "tune").

    mmwave-loc tune-imm --radios handset --imms imm-tuned --json imms.json
    mmwave-loc tune-imm --radios handset --banks maneuvers --out banks
    """

    scenario: str = "mixed"
    """kind of user: a name, a JSON file or a CSV file"""
    radios: tuple[str, ...] = tuple(RADIOS)
    """radio profiles: names or JSON files"""
    imms: tuple[str, ...] = tuple(TUNED_IMMS)
    """imm-tuned (of ekf, ukf), imm-robust (of ekf-robust, ukf-robust), imm-extended (of eight): the
    transition; with -limited after the name the process noise of two modes as well, and outliers
    count in the likelihoods up to a quantile"""
    banks: tuple[str, ...] = ()
    """in place of IMMs: maneuvers, two, three, proportional, doubting, reacquire or two-levels;
    each is compared with the first"""
    scenes: tuple[str, ...] = tuple(SCENES)
    """where the episodes of banks are, in equal shares; IMMs are tuned on the street"""
    steps: tuple[float, ...] = (1.0, 0.1)
    """seconds between the epochs of banks, in equal shares; those of IMMs are 1 s apart"""
    episodes: int = 1000
    """how many"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    held_out: int = 1000
    """how many of the seeds that follow show whether it holds"""
    evaluations: int = 1000
    """at most, per IMM"""
    json: Path | None = None
    """write the results here, beside those it holds; policies/data/imms.json is such a file"""
    out: Path | None = None
    """folder for a bank file a radio, as mmwave_env/data/banks has them"""
    docs: Path | None = None
    """also renew the tables of this page, a radio each, between its `<!-- table: ... -->` lines"""


Build = Callable[[Array], tuple[tuple[Mode, ...], Array]]

RIVAL = "imm-robust-limited"  # the strongest IMM before there were banks
SHARES = 3  # of the tuning episodes, of which a generation of the search sees one
NOISE = {"sigma_p": (0.005, 2.0), "sigma_v": (0.03, 4.0)}  # as tune's RANGES, but lower


def imm_space(modes: tuple[Mode, ...], noise: bool) -> tuple[Array, Array, Build]:
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
    rows = None if transition is None else tuple(map(tuple, transition.tolist()))
    imm = ImmEngine(Pipeline(modes, on.layout), TrackingReward(), rows, q)
    earned = imm.run(on, "reward")["reward"]
    return earned[:, scored(earned.shape[1])].mean(axis=1)  # type: ignore[no-any-return]


def tune(
    modes: tuple[Mode, ...], limited: bool, episodes: EpisodeBatch, evaluations: int
) -> tuple[tuple[Mode, ...], Array]:
    """The modes and the transition of the best IMM that Powell's method finds.

    The reward has small steps, where a link passes a gate or does not, so no gradients.
    """
    start, bounds, build = imm_space(modes, limited)
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
    with progress(f"{name}, {radio}"):
        modes, transition = tune(started, bank.limited, tuning, args.evaluations)
    found: dict[str, Interval] = {}
    for prefix, episodes in (("", tuning), ("held_out_", held_out)):
        reward = rewards(modes, transition, q, episodes)
        gain = reward - rewards(started, None, 1.0, episodes)
        pair = bootstrap(np.stack([reward, gain], axis=1))
        found[f"{prefix}reward"], found[f"{prefix}gain"] = pair
    say(f"{radio} {name}: reward {found['reward']}, gain {found['gain']}; held out "
          f"{found['held_out_reward']}, gain {found['held_out_gain']}")  # fmt: skip
    return {
        "command": command_line(
            "tune-imm", replace(args, radios=(radio,), imms=(name,), json=None)
        ),
        "modes": [as_written(mode) for mode in modes],
        "transition": transition.tolist(),
        "nis_quantile": q,
        **{what: interval.json for what, interval in found.items()},
    }


def tune_imms(args: Args) -> None:
    """Tune IMMs of named modes, in few numbers."""
    for name in args.imms:
        choose(TUNED_IMMS, name, "imms")
    found = recorded(args.json)
    for radio in args.radios:
        for name in args.imms:
            found.setdefault(radio, {})[name] = tuned(args, radio, name)
            if args.json:
                write_json(args.json, found)


def recorded(path: Path | None) -> dict[str, Any]:
    """The results that a file holds already, by radio."""
    if path is None or not path.is_file():
        return {}
    return read_json(path, "a file of tuned IMMs", _by_radio)


def _by_radio(found: dict[str, Any]) -> dict[str, Any]:
    """The content of such a file, where there is an object for every radio."""
    for radio, banks in found.items():
        if not isinstance(banks, dict):
            raise ValueError(f"{radio}: found {quoted(banks)}, expected an object")
    return found


class TunedBank(NamedTuple):
    """A bank, and what came of it on held-out episodes."""

    bank: Bank
    numbers: int  # how many were tuned
    seconds: float  # of one core
    scores: Scores


def tuned_bank(
    name: str, tuning: list[list[EpisodeBatch]], held_out: list[EpisodeBatch], evaluations: int
) -> TunedBank:
    """The best bank of a design that the search finds on tuning episodes, in shares."""
    space = search_space(DESIGNS[name])

    def value(bank: Bank, generation: int) -> float:
        return float(scores(bank, tuning[generation % len(tuning)]).reward.mean())

    began = process_time()
    with progress(name):
        bank = best_bank_of(space, value, evaluations)
    return TunedBank(bank, len(space.start), process_time() - began, scores(bank, held_out))


def figures_of(found: TunedBank, rival: Scores, first: TunedBank) -> dict[str, Interval]:
    """What a bank earns on held-out episodes; differences are paired.

    Args:
        found: the bank.
        rival: what :data:`RIVAL` earns.
        first: the bank that the others of the command are compared with.
    """
    reward = found.scores.reward
    columns = {
        "reward": reward,
        f"minus {RIVAL}": reward - rival.reward,
        "minus the first": reward - first.scores.reward,
        "lost": found.scores.lost,
    }
    return dict(zip(columns, bootstrap(np.stack([*columns.values()], axis=1)), strict=True))


def banks_of(args: Args, radio: str) -> tuple[dict[str, TunedBank], dict[str, dict[str, Interval]]]:
    """The best bank of each design for a radio, and what it earns, by name."""
    sources = [
        source_of(WorldArgs(scenario=args.scenario, radio=radio, scene=scene, dt=dt))
        for scene in args.scenes
        for dt in args.steps
    ]
    first = args.seed + args.episodes // len(sources)
    tuning = drawn(sources, range(args.seed, first), SHARES)
    (held_out,) = drawn(sources, range(first, first + args.held_out // len(sources)))
    rival = scores(tuned_imm(RIVAL, radio), held_out)
    banks: dict[str, TunedBank] = {}
    figures: dict[str, dict[str, Interval]] = {}
    for name in args.banks:
        banks[name] = tuned_bank(name, tuning, held_out, args.evaluations)
        figures[name] = figures_of(banks[name], rival, banks[args.banks[0]])
        figure = f"reward minus {RIVAL} {figures[name][f'minus {RIVAL}']}"
        say(f"{radio} {name}: {banks[name].seconds:.0f} s, {figure}")
    return banks, figures


def as_recorded(found: TunedBank, figures: dict[str, Interval], args: Args) -> dict[str, Any]:
    """A tuned bank as a file holds it.

    Args:
        found, figures: the bank and what it earns.
        args: of the command that makes it.
    """
    return {
        "command": command_line("tune-imm", replace(args, json=None, out=None, docs=None)),
        "modes": [as_written(mode) for mode in found.bank.modes],
        "transition": [list(row) for row in found.bank.probabilities],
        "nis_quantile": found.bank.nis_quantile,
        "numbers": found.numbers,
        "seconds": round(found.seconds),
        "held_out": {what: interval.json for what, interval in figures.items()},
    }


def bank_table(banks: dict[str, TunedBank], figures: dict[str, dict[str, Interval]]) -> str:
    """Tuned banks as Markdown, a row each."""
    header = ["bank", "modes", "numbers", "tuned for", "reward", f"minus {RIVAL}"]
    header += [f"minus {next(iter(banks))}", "lost"]
    rows = [
        [
            name, str(len(bank.bank.modes)), str(bank.numbers), f"{bank.seconds:.0f} s",
            *(str(interval) for interval in list(figures[name].values())[:-1]),
            f"{figures[name]['lost'].mean:.2%}",
        ]
        for name, bank in banks.items()
    ]  # fmt: skip
    rows[0][-2] = ""  # minus itself
    return grid(header, rows)


def names_of(args: Args) -> dict[str, str]:
    """What the results of each radio go by, so their files, too: of a radio's file, its stem.

    Raises:
        ValueError: two radios go by one name, or the result would replace a radio's file.
    """
    names: dict[str, str] = {}
    for radio in args.radios:
        name = Path(radio).stem if radio.endswith(".json") else radio
        if name in names.values():
            raise ValueError(f"radios: found two that go by {name!r}, expected one of them")
        names[radio] = name
    files = {Path(radio).resolve(): radio for radio in names if radio.endswith(".json")}
    results = [args.out / f"{name}.json" for name in names.values()] if args.out else []
    for result in results:
        if result.resolve() in files:
            raise ValueError(
                f"out: found {result}, which is the radio {files[result.resolve()]}, expected "
                "another folder for the result"
            )
    return names


def tune_banks(args: Args) -> None:
    """Tune whole banks, each in everything that is data, on all scenes at once."""
    for name in args.banks:
        choose(DESIGNS, name, "banks")
    if args.out and len(args.banks) > 1:
        raise ValueError(f"banks: found {len(args.banks)}, expected one for the files of --out")
    for option in ("scenes", "steps"):
        if not getattr(args, option):
            raise ValueError(f"{option}: found none, expected one or more")
    names = names_of(args)
    require_extra("cmaes", "tune", "tune-imm --banks")
    page = page_to_renew(args.docs) if args.docs else ""
    tables, content = {}, recorded(args.json)
    for radio, name in names.items():
        banks, figures = banks_of(args, radio)
        alone = replace(args, radios=(radio,))
        content[name] = {n: as_recorded(banks[n], figures[n], alone) for n in banks}
        tables[name] = bank_table(banks, figures)
        show(f"### {name}\n\n{tables[name]}\n")
        if args.out:
            write_json(args.out / f"{name}.json", content[name][args.banks[0]])
        if args.json:
            write_json(args.json, content)
    if args.docs:
        write_text(args.docs, renewed(page, tables))


def main(args: Args) -> None:
    """Run the command."""
    require_tuning_seed(args.seed)
    (tune_banks if args.banks else tune_imms)(args)
