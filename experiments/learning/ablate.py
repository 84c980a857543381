"""mmwave-loc ablate: what every part of the training is worth."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from types import MappingProxyType
from typing import Any, NamedTuple

from experiments import train
from experiments.arguments.train import Args as TrainArgs
from experiments.cli.main import run
from experiments.evaluation.terminal import say
from experiments.learning.arguments.ablate import Args
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from mmwave_env.files import write_json
from mmwave_env.filters.mode_files import as_written, default_modes
from mmwave_env.lookup import choose
from mmwave_env.models.radio import radio_from


class Variant(NamedTuple):
    """What is other than in the training of the shipped switchers."""

    options: Mapping[str, Any] = MappingProxyType({})  # of ``mmwave-loc train``
    recipe: Mapping[str, Any] = MappingProxyType({})  # hyperparameters
    one_tuning: bool = False  # both algorithms work with the UKF's process noise


VARIANTS = {
    "as-shipped": Variant(),
    "prior-observation": Variant({"observation": "prior"}),
    "one-tuning": Variant(one_tuning=True),
    "log-score": Variant({"reward": "log-score"}),
    "no-nees": Variant({"nees_weight": 0.0}),
    "more-nees": Variant({"nees_weight": 1.0}),
    "unpaired": Variant(recipe={"paired": False}),
    "truth-critic": Variant(recipe={"truth_critic": True}),
    "four-frames": Variant(recipe={"frames": 4}),
    "recurrent": Variant({"algo": "recurrent-ppo"}),
    "larger": Variant(recipe={"hidden": (128, 128)}),
}


def training(args: Args, name: str) -> TrainArgs:
    """The training of a variant; files of what is changed in it lie beside its run."""
    variant = choose(VARIANTS, name, "variant")
    out = args.out / name
    options = TrainArgs(
        radio=args.radio, modes=args.modes, seeds=args.seeds, jobs=args.jobs, out=out,
        total_timesteps=args.total_timesteps, resume=args.resume and (out / "run.json").is_file(),
    )  # fmt: skip
    options = replace(options, **variant.options)
    if variant.recipe:
        shipped = shipped_hyperparameters(options.algo)
        recipe = replace(read_hyperparameters(shipped, options.algo), **variant.recipe)
        path = args.out / f"{name}.json"
        write_json(path, asdict(recipe))
        options = replace(options, hyperparameters=path)
    if variant.one_tuning:
        low, high = default_modes(radio_from(args.radio).name)
        path = args.out / f"{name}-modes.json"
        alike = [replace(high, name=low.name, algorithm=low.algorithm), high]
        write_json(path, {"modes": [as_written(mode) for mode in alike]})
        options = replace(options, modes=(str(path),))
    return options


def main(args: Args) -> None:
    """Run the command."""
    for options in [training(args, name) for name in args.variants or VARIANTS]:
        say("", options.out.name, "")
        train.main(options)


if __name__ == "__main__":
    run("ablate")
