"""Features are standardized by constants that a command measures, and are of size one elsewhere."""

import gymnasium as gym
import numpy as np
import pytest

from experiments.learning.standardize import SEED, moments, tasks, typical
from mmwave_env.observation import LIMIT, feature_scales
from tests.cli import command

FRESH = SEED + 1_000_000
EPISODES = 24


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
    """Distances are smaller than in most places; nothing else is far from deviation one."""
    _, shown = observed(EPISODES, 200, FRESH)
    assert (np.abs(np.mean(shown, axis=(0, 1))) < 1.5).all()
    assert np.abs(shown).max() <= np.float32(LIMIT)
    spread = np.std(shown, axis=(0, 1))
    assert (spread > 0.25).all() and (spread < 2.0).all()


def moments_of(*values):
    """Of one kind, as if an episode had shown each list of values."""
    return {"kind": np.array([[np.mean(v), np.mean(np.square(v))] for v in values]).T}


def test_constants_are_medians_over_the_tasks_in_which_a_kind_varies():
    wild = moments_of([-3000.0], [3000.0])
    found = [moments_of(*each) for each in ([[1.0, 3.0]] * 2, [[2.0], [8.0]], [[4.0], [4.0]])]
    found.append(wild)
    assert typical(found) == {"kind": (2.0, 3.0)}
    assert typical([*found, {"other": wild["kind"]}])["kind"] == (2.0, 3.0)


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
def test_the_table_has_every_kind_and_fits_fresh_episodes_of_every_sort_of_task():
    """At one place: shared beliefs and one a mode, two modes, eight and a bank."""
    some = [t for t in tasks() if (t["scene"], t["radio"]) == ("o1", "standard")]
    found = typical([moments(task, 4, FRESH) for task in some])
    assert set(found) == set(feature_scales())
    for kind, scale in feature_scales().items():
        mean, deviation = found[kind]
        assert abs(mean - scale.mean) < 1.5 * scale.deviation, kind
        assert 0.4 < deviation / scale.deviation < 2.5, kind
