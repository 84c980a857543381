"""Tests that a vector environment continues from a saved state with identical results."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource
from tests.environment.test_vector_env import LOSING
from tests.environment.vector_checker import forward, same
from tests.paths import representative
from tests.refusals import refuses
from tests.training.actors import MODES

AUTORESET = ["NextStep", "SameStep", "Disabled"]
CONFIGURATIONS = {
    "short": {"episode_steps": 1, "dt": 0.5},
    "ends early": {"episode_steps": 18, "terminate_on_divergence": True} | LOSING,
    "per mode": {"episode_steps": 4, "beliefs": "per-mode"},
    "paired": {"episode_steps": 4, "reward": "paired"},
    "flat": {"episode_steps": 5, "planar": True, "dt": 0.5, "modes": MODES[:1]},
}


def make(mode="SameStep", n=9, **arguments):
    arguments = {"modes": MODES, "episode_steps": 5} | arguments
    return gym.make_vec("MmWaveLoc-v0", num_envs=n, autoreset_mode=mode, **arguments)


def go_on(env, steps, actions):
    """Return the results of random steps; ``actions`` is the seed of the actions."""
    rng = np.random.default_rng(actions)
    modes = env.single_action_space.n
    return [forward(env, rng.integers(modes, size=env.num_envs)) for _ in range(steps)]


@pytest.mark.parametrize("configuration", representative(CONFIGURATIONS, "ends early", "short"))
@pytest.mark.parametrize("mode", AUTORESET)
def test_environments_continue_from_a_state_saved_at_any_step(mode, configuration):
    """Check a state restored in a new environment, in a used environment and in the original."""
    env = make(mode, **CONFIGURATIONS[configuration])
    elsewhere = make(mode, **CONFIGURATIONS[configuration])
    elsewhere.reset(seed=50)
    go_on(elsewhere, 2, actions=9)
    env.reset(seed=13)  # with this seed, "ends early" terminates and truncates episodes
    ends = np.zeros(2, int)  # numbers of terminated and of truncated episodes
    for taken in range(8):
        state = env.state()
        expected = go_on(env, 24, actions=taken)
        ends += np.sum([step[0][2:4] for step in expected], axis=(0, 2))
        for other in (make(mode, **CONFIGURATIONS[configuration]), elsewhere, env):
            other.restore(state)
            assert same(go_on(other, 24, actions=taken), expected)
        env.restore(state)
        go_on(env, 1, actions=100 + taken)
    assert ends[1] > 20 and (ends[0] > 0) == (configuration == "ends early")


@pytest.mark.parametrize("mode", AUTORESET)
def test_a_reset_after_a_restore_draws_the_same_episodes(mode):
    env = make(mode)
    other = make(mode)
    env.reset(seed=[None, *range(8)])  # the first environment has no seed
    go_on(env, 3, actions=0)
    other.restore(env.state())
    assert same(env.reset(), other.reset())
    assert other.np_random_seed == (-1,) * 9  # as in Gymnasium, if seeds are unknown


def test_later_steps_do_not_change_a_saved_state():
    env = make()
    env.reset(seed=0)
    state = env.state()
    kept = {key: value.copy() for key, value in state.items()}
    go_on(env, 6, actions=0)
    assert same(state, kept)
    env.restore(state)
    go_on(env, 6, actions=0)
    assert same(state, kept)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("streams", {"n": 10}),
        ("streams", {"n": 20}),
        ("rows", {"modes": MODES[:2]}),
        ("rows", {"observation": "prior"}),
        ("length", {"episode_steps": 6}),
    ],
)
def test_the_state_of_another_environment_is_refused(name, arguments):
    env = make()
    other = make(**arguments)
    env.reset(seed=0)
    with refuses(f"{name} of the state"):
        other.restore(env.state())
    with pytest.raises(ResetNeeded):  # this environment was neither restored nor reset
        other.state()


def test_the_error_names_a_missing_part_of_a_state():
    env = make()
    env.reset(seed=0)
    state = env.state()
    del state["over"]
    with refuses("over of the state"):
        env.restore(state)


class Own(SimulatedSource):
    """A custom source of episodes, which might have a memory that the state lacks."""


@pytest.mark.parametrize(
    "episodes",
    ["canyon28_pedestrian", Own(SCENES["street"], RADIOS["handset"], epochs=4)],
    ids=["recorded", "own"],
)
def test_sources_that_may_have_a_memory_are_refused(episodes):
    env = make(episodes=episodes, episode_steps=None)
    simulated = make()
    for each in (env, simulated):
        each.reset(seed=0)
    with refuses("state"):
        env.state()
    with refuses("restore"):
        env.restore(simulated.state())
