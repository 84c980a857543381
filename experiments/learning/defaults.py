"""PPO with every setting at its library's default: do others' agents learn without a wrapper?

No setting is chosen, no observation normalized, no reward scaled: this is what a newcomer gets who
points Stable-Baselines3 or CleanRL at the environment.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from statistics import median
from time import process_time
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np

from experiments.evaluation.agents import Act
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.intervals import Interval, over_seeds_and_episodes
from experiments.evaluation.markdown import grid
from experiments.evaluation.runner import score
from experiments.evaluation.seeds import SEEDS_EACH, TRAINING_SEED, draw_episodes
from experiments.evaluation.terminal import tracked
from experiments.training.places import Place
from mmwave_env.numerics.arrays import Array

ENV = "mmwave_env:MmWaveLoc-v0"
RADIO = "handset"
BELIEFS = ("shared", "per-mode")
RIVALS = ("fixed-ukf", "speed-rule", "imm")
STEPS, EPISODES = 500_000, 2000  # of a training; on test seeds


def stable_baselines3(beliefs: str, steps: int, seed: int) -> Act:
    """PPO of Stable-Baselines3, on one environment."""
    from stable_baselines3 import PPO

    model = PPO("MlpPolicy", gym.make(ENV, beliefs=beliefs), seed=seed, device="cpu")
    model.learn(steps)
    return lambda observations: model.predict(observations, deterministic=True)[0]


def cleanrl(beliefs: str, steps: int, seed: int) -> Act:
    """PPO as CleanRL has it, on four environments."""
    from experiments.learning.plain_ppo import ENVIRONMENTS, train

    envs = gym.make_vec(ENV, ENVIRONMENTS, beliefs=beliefs, autoreset_mode="SameStep")
    return train(envs, steps, seed)


LIBRARIES: Mapping[str, Callable[[str, int, int], Act]] = MappingProxyType(
    {"Stable-Baselines3": stable_baselines3, "CleanRL": cleanrl}
)


def trained(library: str, beliefs: str, steps: int, episodes: int, training: int) -> dict[str, Any]:
    """One training: the rewards of its agent on test episodes, and seconds of a core it took."""
    import torch

    torch.set_num_threads(1)
    began = process_time()
    act = LIBRARIES[library](beliefs, steps, TRAINING_SEED + training * SEEDS_EACH)
    seconds = process_time() - began
    agent = Contender.own(library, act, RADIO, beliefs=beliefs)
    return {"seconds": seconds, "rewards": _rewards(agent, episodes)}


def _rewards(contender: Contender, episodes: int) -> Array:
    """Rewards (episodes,) on test seeds."""
    source = Place("street", RADIO).source("mixed")
    drawn = draw_episodes(source, range(episodes))
    return score(contender, contender.start(source.layout), drawn)["reward"]


def defaults(steps: int, seeds: int, episodes: int = EPISODES) -> dict[str, Any]:
    """Train all, as many at once as there are cores; the record that the table is made of.

    Args:
        steps: of a training.
        seeds: trainings of each library with each kind of beliefs.
        episodes: to judge them on.
    """
    kinds = [(library, beliefs) for library in LIBRARIES for beliefs in BELIEFS]
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        jobs = {
            kind: [pool.submit(trained, *kind, steps, episodes, k) for k in range(seeds)]
            for kind in kinds
        }
        rivals = {name: _rewards(contender_from(name, RADIO), episodes) for name in RIVALS}
        rows = [
            _row(*kind, [job.result() for job in some], rivals)
            for kind, some in tracked(jobs.items(), "defaults", len(jobs))
        ]
    return {"steps": steps, "seeds": seeds, "episodes": episodes, "rows": rows}


def _row(
    library: str, beliefs: str, found: Sequence[dict[str, Any]], rivals: Mapping[str, Array]
) -> dict[str, Any]:
    rewards = np.stack([one["rewards"] for one in found])
    gains = {f"minus {name}": over_seeds_and_episodes(rewards - rivals[name]) for name in rivals}
    return {
        "library": library, "beliefs": beliefs,
        "seconds": round(median(one["seconds"] for one in found)),
        "each": rewards.mean(axis=1).tolist(),
    } | {name: gain.json for name, gain in gains.items()}  # fmt: skip


def defaults_table(record: Mapping[str, Any]) -> str:
    """A record of :func:`defaults` as Markdown."""
    columns = [f"minus {name}" for name in RIVALS]
    lines = [
        [row["library"], row["beliefs"], f"{row['seconds']} s"]
        + [str(Interval(row[column]["mean"], *row[column]["ci95"])) for column in columns]
        for row in record["rows"]
    ]
    return grid(["PPO of", "beliefs", "core time", *columns], lines)
