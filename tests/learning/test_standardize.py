"""Features are standardized by constants that a command measures, and are of size one elsewhere."""

import gymnasium as gym
import numpy as np
import pytest
from scipy.stats import t

from experiments.learning.standardize import SEED, moments, pooled, tasks
from mmwave_env.observation import feature_scales
from tests.cli import command

FRESH = SEED + 1_000_000
EPISODES = 64


def observed(episodes, steps, seed):
    """The table of the default task, and observations (steps, episodes, features) in it."""
    envs = gym.make_vec(
        "MmWaveLoc-v0", num_envs=episodes, autoreset_mode="Disabled", episode_steps=steps
    )
    rng = np.random.default_rng(seed)
    shown = [envs.reset(seed=seed)[0]]
    shown += [envs.step(rng.integers(2, size=episodes))[0] for _ in range(steps - 1)]
    return envs.unwrapped.observation, np.array(shown)


def test_observations_of_the_default_task_are_of_size_one():
    _, shown = observed(EPISODES, 200, FRESH)
    assert (np.abs(np.mean(shown, axis=(0, 1))) < 1.5).all()
    spread = np.std(shown, axis=(0, 1))
    assert (spread > 0.1).all() and (spread < 2.5).all()


def test_an_episode_s_moments_are_those_of_what_it_shows():
    mean, square = moments({"episode_steps": 5}, 3)["SNR"]
    table, shown = observed(3, 5, SEED)
    snr = np.stack([table.read(shown, f"SNR anchor {a}") for a in (1, 2, 3)])
    assert mean.shape == (3,)
    np.testing.assert_allclose(mean, snr.mean(axis=(0, 1)))
    np.testing.assert_allclose(square, (snr**2).mean(axis=(0, 1)))


@pytest.mark.parametrize("words", [("--episodes", 0), ("--out", "/")])
def test_what_can_t_be_measured_or_written_is_refused_at_once(words):
    done = command("standardize", *words)
    assert done.returncode == 2 and "found" in done.stderr


@pytest.mark.slow
def test_the_table_is_what_the_command_measures_and_holds_for_fresh_episodes():
    """On other training seeds every kind has mean 0 and square 1, at 99 % for all of them together.

    Episodes of a seed are alike in all tasks, so a seed is one draw; the table is as uncertain as
    what it is compared with.
    """
    done = command("standardize", "--check")
    assert done.returncode == 0, done.stderr
    found = pooled([moments(task, EPISODES, FRESH) for task in tasks()])
    quantile = t.ppf(1.0 - 0.01 / (4.0 * len(found)), EPISODES - 1)
    for kind, (value, square) in found.items():
        mean, deviation = feature_scales()[kind]
        first = (value - mean) / deviation
        second = (square - 2.0 * mean * value + mean**2) / deviation**2 - 1.0
        for off in (first, second):
            bound = quantile * np.sqrt(2.0 / EPISODES) * off.std(ddof=1)
            assert abs(off.mean()) < bound + 0.01, kind  # 0.01: the table is rounded
