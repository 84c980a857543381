"""mmwave-loc collect: what policies see, choose and earn, as a Minari data set."""

import warnings
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.arguments.collect import Args
from experiments.cli.main import run
from experiments.cli.options import contender_of, provenance, source_of, world_arguments
from experiments.evaluation.contenders import Contender
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.seeds import require_seeds, require_training_seed
from experiments.evaluation.terminal import say, tracked
from experiments.offline.behaviors import behaviors, environment_of
from experiments.offline.minari_folder import add_episodes, folder_for, new_dataset, require_minari
from experiments.offline.transitions import Transitions, collect, environments
from mmwave_env import __version__
from mmwave_env.episodes.samples import sample_names
from mmwave_env.numerics.arrays import Array
from mmwave_env.task import TaskArguments
from mmwave_env.vector_env import MmWaveLocVectorEnv


def main(args: Args) -> None:
    """Run the command."""
    require_minari("collect")
    seeds = range(args.seed, args.seed + args.episodes)
    require_seeds(seeds)
    require_training_seed(args.seed)
    if args.data in sample_names():
        warnings.warn(
            f"data: {args.data} is for tests; what learns from it has seen them", stacklevel=2
        )
    folder, epochs = folder_for(args.id, args.out, args.overwrite), source_of(args).epochs
    players = behaviors(
        args.policies, args.radio, partial(contender_of, args), args.modes or None, args.beliefs,
        args.observation,
    )  # fmt: skip
    arguments = _world(args) | environment_of(players[0])
    count = environments(len(seeds), epochs)
    envs = MmWaveLocVectorEnv(count, autoreset_mode="Disabled", **arguments)
    spec = replace(gym.spec("MmWaveLoc-v0"), kwargs=arguments, max_episode_steps=epochs)
    spaces = envs.single_observation_space, envs.single_action_space
    actions = players[0].actions
    ways = {player.name: collect(player, envs, seeds) for player in players}
    parts = ((name, part) for name, way in ways.items() for part in way)
    rows: dict[str, list[Array]] = {name: [] for name in ways}
    with new_dataset(folder, spec, spaces, _about(args, players)) as storage:
        for name, part in tracked(parts, "collecting", len(players) * -(-len(seeds) // count)):
            add_episodes(storage, name, part)
            rows[name].append(_row_each(part, len(actions)))
        means = {name: np.concatenate(found).mean(axis=0) for name, found in rows.items()}
        storage.update_metadata(_reference_scores(means, len(seeds)))
    show(_table(means, actions))
    say("", f"written to {folder}; to be loaded with minari.load_dataset({args.id!r})")


def _world(args: Args) -> dict[str, Any]:
    """The arguments of the environment that are not as usual, but for its modes."""
    usual = {field.name: field.default for field in fields(TaskArguments)}
    return {name: value for name, value in world_arguments(args).items() if value != usual[name]}


def _about(args: Args, players: Sequence[Contender]) -> dict[str, Any]:
    """Metadata of the data set, with the names that Minari has for them, and the command."""
    names = ", ".join(player.name for player in players)
    return {
        "dataset_id": args.id,
        "algorithm_name": names,
        "author": {"mmwave-loc"},
        "description": f"{names}, each in the same {args.episodes} episodes of MmWaveLoc-v0",
        "requirements": [f"mmwave-loc>={__version__}"],
        "actions": players[0].actions,
        **provenance("collect", replace(args, overwrite=False)),
    }


def _row_each(played: Transitions, actions: int) -> Array:
    """(n, 2 + actions) of each episode: return, mean position error in m, shares of the actions."""
    error_m = np.nanmean(played.infos["position_error_m"], axis=1)
    shares = (played.actions[:, :, None] == np.arange(actions)).mean(axis=1)
    return np.column_stack([played.rewards.sum(axis=1), error_m, shares])


def _reference_scores(means: dict[str, Array], episodes: int) -> dict[str, Any]:
    """What Minari normalizes returns with: those of chance and of the best, if chance is there."""
    if "random" not in means:
        return {}
    returns = {name: float(mean[0]) for name, mean in means.items()}
    return {
        "ref_min_score": returns["random"],
        "ref_max_score": max(returns.values()),
        "num_episodes_average_score": episodes,
    }


def _table(means: dict[str, Array], actions: Sequence[str]) -> str:
    header = ["policy", "return", "position error m", *actions]
    rows = [
        [name, f"{mean[0]:.1f}", f"{mean[1]:.3f}", *(f"{share:.0%}" for share in mean[2:])]
        for name, mean in means.items()
    ]
    return grid(header, rows)


if __name__ == "__main__":
    run("collect")
