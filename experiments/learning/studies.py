"""mmwave-loc studies: what beliefs per mode, rollouts, places and modes are worth."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from experiments import train
from experiments.arguments.train import Args as TrainArgs
from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.seeds import TUNING_SEED
from experiments.evaluation.terminal import say
from experiments.learning.arguments.studies import Args
from experiments.learning.defaults import STEPS as DEFAULT_STEPS
from experiments.learning.defaults import defaults
from experiments.learning.evolution import evolved
from experiments.training.places import Place, place_from
from experiments.tuning.designs import Design
from experiments.tuning.scores import drawn, scores
from experiments.tuning.search import best_bank_of
from experiments.tuning.search_space import search_space
from mmwave_env.files import write_json
from mmwave_env.filters.bank import Bank, bank_as_written, best_bank
from mmwave_env.lookup import choose, require_extra

# As many as take about two minutes of one core.
PPO_STEPS, BRANCH_STATES = 1_500_000, 330_000
BANK_EPISODES, BANK_SHARES = 450, 3  # of the tuning of a bank; a generation sees one share
STREET = "street:handset"


class Training(NamedTuple):
    """A training, and what is other in it."""

    algo: Literal["ppo", "branch"] = "branch"
    beliefs: Literal["shared", "per-mode"] = "per-mode"
    places: tuple[str, ...] = (STREET,)
    without: tuple[str, ...] = ()  # modes of the radio's best bank that are left out


TRAININGS: Mapping[str, Training] = MappingProxyType({
    "shared": Training("ppo", "shared"),
    "ppo": Training("ppo"),
    "branch": Training(),
    "many-places": Training(
        places=tuple(
            f"{scene}:{radio}"
            for scene in ("street", "o1", "dynamic-doppler")
            for radio in ("handset", "standard", "high")
        )
    ),
    "random-streets": Training(places=("random:handset",)),
    "no-accelerate-brake": Training(without=("accelerate", "brake")),
    "no-turn": Training(without=("turn",)),
})  # fmt: skip
EVOLUTION, DEFAULTS = "evolution", "defaults"
RECORDS = {EVOLUTION: "trust.json", DEFAULTS: "rewards.json"}  # of others: summary.json


def bank_without(names: tuple[str, ...], place: Place, evaluations: int) -> Bank:
    """The modes of the radio's best bank but for some, tuned anew on tuning episodes of a place.

    A bank out of which a mode is only taken would be worse than it need be: noise and transitions
    of the others were tuned beside it.

    Raises:
        ValueError: a name that no mode has.
    """
    modes = {mode.name: mode for mode in best_bank(place.profile).modes}
    for name in names:
        choose(modes, name, "mode")
    tuning = drawn(
        [place.source("mixed")], range(TUNING_SEED, TUNING_SEED + BANK_EPISODES), BANK_SHARES
    )

    def value(bank: Bank, generation: int) -> float:
        return float(scores(bank, tuning[generation % BANK_SHARES]).reward.mean())

    kept = tuple(mode for name, mode in modes.items() if name not in names)
    return best_bank_of(search_space(Design(kept)), value, evaluations)


def options_of(args: Args, name: str) -> TrainArgs:
    """The training as ``mmwave-loc train`` takes it; a bank of its own lies beside its run."""
    training, out = TRAININGS[name], args.out / name
    steps = PPO_STEPS if training.algo == "ppo" else BRANCH_STATES
    modes: tuple[str, ...] = ()
    if training.without or training.beliefs == "shared":
        path = args.out / f"{name}-bank.json"
        if not path.is_file():
            write_json(path, bank_as_written(_bank_of(args, training)))
        modes = (str(path),)
    return TrainArgs(
        algo=training.algo, beliefs=training.beliefs, places=training.places, modes=modes,
        seeds=args.seeds, jobs=1, total_timesteps=args.total_timesteps or steps, out=out,
        resume=(out / "run.json").is_file(),
    )  # fmt: skip


def _bank_of(args: Args, training: Training) -> Bank:
    """The bank that a training gets as a file."""
    place = place_from(training.places[0])
    if not training.without:
        return best_bank(place.profile)
    require_extra("cmaes", "tune", "a bank without some modes")
    return bank_without(training.without, place, args.evaluations)


def record_of(folder: Path, name: str) -> Path:
    """The file that is there once a training is recorded, in a folder of studies."""
    return folder / name / RECORDS.get(name, "summary.json")


def evolution(args: Args) -> None:
    """Search continuous trust by an evolution strategy, and record what was found."""
    require_extra("cmaes", "tune", "studies --trainings evolution")
    place = place_from(STREET)
    trust, figures = evolved(
        best_bank(place.profile), place.source("mixed"), args.generations,
        lambda generation, gain: say(f"{generation} generations: {gain:+.4f} over its IMM"),
    )  # fmt: skip
    _write_record(args, EVOLUTION, figures | trust.json)


def of_libraries(args: Args) -> None:
    """Train with the defaults of other libraries, and record what it came to."""
    require_extra("stable_baselines3", "train", "studies --trainings defaults")
    steps = args.total_timesteps or DEFAULT_STEPS
    _write_record(args, DEFAULTS, defaults(steps, args.seeds, args.episodes))


def _write_record(args: Args, name: str, found: dict[str, Any]) -> None:
    alone = replace(args, trainings=(name,), out=Args.out)
    write_json(record_of(args.out, name), provenance("studies", alone) | found)


def main(args: Args) -> None:
    """Run the command."""
    makers = {name: partial(_train, args, name) for name in TRAININGS}
    makers |= {EVOLUTION: partial(evolution, args), DEFAULTS: partial(of_libraries, args)}
    for name in args.trainings or makers:
        make, record = choose(makers, name, "trainings"), record_of(args.out, name)
        say("", name, "")
        if record.is_file():
            say(f"{record} is there already")
        else:
            make()


def _train(args: Args, name: str) -> None:
    """Run a training."""
    train.main(options_of(args, name))


if __name__ == "__main__":
    run("studies")
