"""mmwave-loc standardize: mean and deviation of every kind of feature in a typical place."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from math import floor, inf, log10
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from experiments.cli.main import run
from experiments.evaluation.terminal import say, tracked
from experiments.learning.arguments.standardize import Args
from mmwave_env import observation
from mmwave_env.files import require_writable, write_json
from mmwave_env.filters.bank import best_bank
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.arrays import Array
from mmwave_env.observation import BELIEFS, Observation, Scale

SEED = 50_000_000  # of the first episode: a training seed that no training has come to
DIGITS = 3  # of a deviation; its mean is as fine
LEAST = 1e-9  # variance over mean square of what is not constant

Moments = dict[str, Array]  # by kind (2, episodes): mean and mean square over an episode


def tasks() -> Iterator[dict[str, Any]]:
    """Arguments of the environments that are measured in, each counting the same."""
    for scene, radio, beliefs in product(SCENES, RADIOS, BELIEFS):
        place = {"scene": scene, "radio": radio, "beliefs": beliefs}
        yield place | {"modes": ["ekf", "ukf"]}
        yield place | {"modes": ["ekf", "ukf"], "odometry": True}
        yield place | {"modes": "extended"}
        yield place | {"modes": list(best_bank(radio).modes)}


@patch.object(observation, "LIMIT", inf)  # or constants would depend on those before them
def moments(task: Mapping[str, Any], episodes: int, seed: int = SEED) -> Moments:
    """Of every kind of feature in an environment, where actions are drawn at random.

    Args:
        task: arguments of the environment.
        episodes: how many; all of their epochs count.
        seed: of the first episode.
    """
    envs: Any = gym.make_vec(
        "mmwave_env:MmWaveLoc-v0", num_envs=episodes, autoreset_mode="Disabled", **task
    )
    rng = np.random.default_rng(seed)
    actions = int(envs.single_action_space.n)
    shown, over = [envs.reset(seed=seed)[0]], np.zeros(episodes, np.bool_)
    while not over.all():
        now, _, _, over, _ = envs.step(rng.integers(actions, size=episodes))
        shown.append(now)
    return _by_kind(envs.unwrapped.observation, np.array(shown[:-1]))  # nothing follows an end


def _by_kind(table: Observation, observations: NDArray[np.float32]) -> Moments:
    """From observations (epochs, episodes, features)."""
    values: dict[str, list[Array]] = {}
    for feature in table.features:
        values.setdefault(feature.kind, []).append(table.read(observations, feature.name))
    return {
        kind: np.array([np.mean(found, axis=(0, 1)), np.mean(np.square(found), axis=(0, 1))])
        for kind, found in values.items()
    }


def typical(found: Sequence[Moments]) -> dict[str, Scale]:
    """Mean and deviation of every kind, each the median over the tasks.

    So a few tasks where tracks are lost, with deviations many times those of the others, don't
    make features small in all of them. A task where a kind is constant, or that lacks it, does
    not count for it.
    """
    kinds = dict.fromkeys(kind for one in found for kind in one)
    return {kind: _median([one[kind] for one in found if kind in one]) for kind in kinds}


def _median(found: Sequence[Array]) -> Scale:
    """The medians of a kind over tasks, rounded."""
    mean, square = np.mean(found, axis=-1).T
    variance = square - mean**2
    varies = variance > LEAST * square
    center, deviation = np.median([mean[varies], np.sqrt(variance[varies])], axis=1).tolist()
    decimals = DIGITS - 1 - floor(log10(deviation))
    return Scale(round(center, decimals), round(deviation, decimals))


def main(args: Args) -> None:
    """Run the command."""
    require_writable(args.out)
    if args.episodes < 1:
        raise ValueError(f"episodes: found {args.episodes}, expected at least 1")
    each = tracked(list(tasks()), "standardize")
    found = typical([moments(task, args.episodes) for task in each])
    write_json(args.out, {
        "command": "mmwave-loc standardize", "seed": SEED, "episodes": args.episodes,
        "kinds": {kind: scale._asdict() for kind, scale in found.items()},
    })  # fmt: skip
    say(f"{args.out}: {len(found)} kinds of features")


if __name__ == "__main__":
    run("standardize")
