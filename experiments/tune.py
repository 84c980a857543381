"""mmwave-loc tune: modes, a complete bank, or protection levels."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from experiments.console.options import TUNING_SEED, JsonArgs, WorldArgs, require_alone


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Tune the process noise of modes by the likelihood of measurements.

    With --bank, tune a bank: the five modes of imm-best and the probabilities of
    changes between them. The reward of the bank's IMM in all scenes, at 1 and 10
    Hz, is maximized. With --levels, train and calibrate the protection levels
    anew. --bank needs the extra "tune"; --levels needs "train".

        mmwave-loc tune --radio handset --out modes.json
        mmwave-loc tune --bank --radio phone.json --episodes 900 --out bank.json
        mmwave-loc tune --levels --out mmwave_env/data/levels.safetensors
    """

    radio: str = "handset"
    """radio profile: handset, standard, high or a JSON file"""
    modes: tuple[str, ...] = ("ekf", "ukf")
    """modes to tune: ekf, ukf, ckf, ekf-robust, ukf-robust, mode files"""
    scenarios: tuple[str, ...] = ("pedestrian", "vehicle")
    """kinds of users to tune on, one for each mode, in the
    same order: names, JSON or CSV files"""
    free: tuple[str, ...] = ("sigma_v", "sigma_p")
    """parameters to tune: sigma_p, sigma_v, sigma_pz, sigma_vz, sigma_b_mps, spread_gain"""
    diagonal: bool = False
    """use the paper's printed process noise, a diagonal matrix without coupling"""
    episodes: int = 300
    """number of episodes to tune on"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    bank: bool = False
    """tune a bank instead of single modes"""
    evaluations: int = 1000
    """with --bank, maximum number of banks to try"""
    levels: bool = False
    """train the network of the protection levels on training
    seeds, and calibrate it on tuning seeds, with the
    shipped policies; the only other options are --seed
    and --out, which is required"""
    out: Path | None = None
    """mode file to write, which `--modes` and the
    environment's `modes` accept; with --levels, file
    (.safetensors) of the network to write"""


OF_MODES = ("modes", "scenarios", "free", "diagonal")  # options that tune single modes
Content = dict[str, Any]  # content of a JSON file


def _tuned_bank(args: Args) -> Content:
    """Tune a bank, and print its reward; return the mode file's content."""
    from experiments.console.progress import say
    from experiments.evaluation.intervals import Interval
    from experiments.training.tune_banks import tuned_bank
    from mmwave_env.models.radio import radio_from

    name = radio_from(args.radio).name
    bank = tuned_bank(args.radio, args.episodes, args.seed, args.evaluations)
    reward = Interval.of(bank["held_out"]["reward"])
    gain = Interval.of(bank["held_out"]["minus imm"])
    say(f"{name}, on new episodes (as many as for tuning): reward {reward}, gain over imm {gain}")
    return bank


def _train_levels(args: Args) -> None:
    """Train the network of protection levels; write its file."""
    from experiments.console.progress import say
    from experiments.console.provenance import provenance
    from experiments.training.levels import trained_levels
    from mmwave_env.io.files import write_bytes

    if args.out is None or args.out.suffix != ".safetensors":
        raise ValueError(f"out: found {args.out}, expected a name that ends with .safetensors")
    network = trained_levels(args.seed)
    write_bytes(args.out, network.to_bytes(provenance("tune", args)["command"]))
    for kind, constants in zip(("filter", "bank", "corrector"), network.constants, strict=True):
        for risk, both in zip(network.risks, constants, strict=True):
            h, v = map(math.exp, both)
            say(f"{kind}, risk {risk:g}: horizontal factor {h:.3f}, vertical factor {v:.3f}")


def _tuned_modes(args: Args) -> tuple[Content, Content]:
    """Tune and print modes one by one; return the mode file's content, and results for --json."""
    from experiments.console.progress import say
    from experiments.evaluation.contenders import source_of
    from experiments.evaluation.intervals import bootstrap
    from experiments.evaluation.seeds import draw_episodes
    from experiments.training.tune_modes import RANGES, objective_of, tune
    from mmwave_env.filters.bank import as_written, modes_from
    from mmwave_env.io.lookup import choose
    from mmwave_env.models.radio import radio_from

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


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.provenance import provenance
    from mmwave_env.io.files import require_writable, write_json

    if args.seed < TUNING_SEED:
        raise ValueError(f"seed: found {args.seed}, expected a tuning seed >= {TUNING_SEED}")
    if args.out:
        require_writable(args.out)
        if args.out.resolve() == Path(args.radio).resolve():
            raise ValueError(f"out: found {args.out}, which is the radio; expected another file")
    require_alone(args, "bank", *OF_MODES)
    require_alone(args, "levels", "bank", "radio", "episodes", "evaluations", "json", *OF_MODES)
    if args.levels:
        _train_levels(args)
        return
    content, figures = (_tuned_bank(args), {}) if args.bank else _tuned_modes(args)
    made = provenance("tune", args)
    if args.json:
        write_json(args.json, made | content | figures)
    if args.out:
        write_json(args.out, {"command": made["command"]} | content)
