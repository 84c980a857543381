"""Tests of features for other libraries: copies, lengths of episodes, fixed infos, clear errors."""

import copy
import math
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.env import MmWaveLocEnv
from mmwave_env.interface.reward import LogScore
from tests.environment.test_vector_env import EKF, ID, Patchy
from tests.environment.vector_checker import same
from tests.refusals import refuses


class Closeness:
    """A reward without ``__eq__``: if it were copied, the copy would be compiled again."""

    compiled = 0

    def __call__(self, belief, truth):
        type(self).compiled += 1
        return -belief.distance(truth)


def go_on(env, steps, seed=0):
    """Return the results of random steps; a non-vector environment is reset after each episode."""
    rng = np.random.default_rng(seed)
    results = []
    if isinstance(env, gym.vector.VectorEnv):
        return [env.step(rng.integers(env.single_action_space.n, size=3)) for _ in range(steps)]
    for _ in range(steps):
        results.append(env.step(rng.integers(env.action_space.n)))
        if results[-1][2] or results[-1][3]:
            results.append(env.reset())
    return results


# --- copies

COPIES = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}
every_way = pytest.mark.parametrize("how", COPIES)
CONFIGURATIONS = {
    "ten epochs a second": {"episode_steps": 25, "dt": 0.1} | EKF,
    "own reward": {"episode_steps": 6, "reward": Closeness()} | EKF,
    "paired": {"episode_steps": 5, "reward": "paired"},
    "recorded": {"episodes": "canyon28_vehicle", "episode_steps": 7} | EKF,
    "filterpy": {"backend": "filterpy", "episode_steps": 4} | EKF,
}


VECTORS = {
    "same step": {"dt": 0.5, "episode_steps": 14, "autoreset_mode": "SameStep"},
    "recorded vectors": {"episodes": "canyon28_vehicle", "episode_steps": 12},
    "paired vectors": {"episode_steps": 5, "reward": "paired", "render_mode": "rgb_array"},
}


@every_way
@pytest.mark.parametrize("configuration", CONFIGURATIONS | VECTORS)
def test_a_copy_continues_independently_with_identical_results(how, configuration):
    """Check copies made before the first reset, and copies made in the middle of an episode."""
    if configuration in VECTORS:
        env = gym.make_vec(ID, num_envs=3, **VECTORS[configuration])
    else:
        env = gym.make(ID, **CONFIGURATIONS[configuration])
    env.action_space.seed(7)
    twin = COPIES[how](env)
    assert same(twin.action_space.sample(), env.action_space.sample())
    assert same(twin.reset(seed=3), env.reset(seed=3))
    go_on(env, 2)
    twin = COPIES[how](env)
    elsewhere = go_on(copy.deepcopy(twin), 26, seed=5)
    expected = go_on(env, 26)
    assert same(go_on(twin, 26), expected)
    if env.action_space != gym.spaces.Discrete(1):
        assert not same(elsewhere, expected)
    if env.render_mode:
        assert same(twin.render(), env.render())
    assert same(twin.reset(), env.reset())


def test_a_deep_copy_compiles_nothing():
    env = gym.make(ID, reward=Closeness(), **EKF)
    env.reset(seed=0)
    env.step(0)
    known = Closeness.compiled
    twin = copy.deepcopy(env)
    twin.step(0)
    assert Closeness.compiled == known > 0
    assert twin.unwrapped.source is env.unwrapped.source


class Noted(MmWaveLocEnv):
    """A subclass of the environment that adds an attribute."""

    def __init__(self, note, **arguments):
        super().__init__(**arguments)
        self.notes = [note]


@every_way
def test_attributes_that_a_subclass_or_a_user_added_are_copied(how):
    env = Noted("mine", **EKF)
    env.label = "added"
    twin = COPIES[how](env)
    twin.notes.append("twin's")
    assert isinstance(twin, Noted) and twin.label == "added"
    assert env.notes == ["mine"] and twin.notes == ["mine", "twin's"]


# --- lengths


@pytest.mark.parametrize(
    ("arguments", "steps"),
    [
        ({}, 200),
        ({"episodes": "canyon28_pedestrian", "episode_steps": 12}, 12),
        ({"episodes": Patchy()}, None),
    ],
)
def test_the_specification_contains_the_length_of_episodes(arguments, steps):
    assert gym.make(ID, **arguments, **EKF).spec.max_episode_steps == steps
    assert gym.spec(ID).max_episode_steps is None


@pytest.mark.parametrize("episode_steps", [None, 5, 250])
def test_an_environment_made_from_a_specification_gives_the_same_results(episode_steps):
    env = gym.make(ID, episode_steps=episode_steps, **EKF)
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert same(again.reset(seed=2), env.reset(seed=2))
    assert same(go_on(again, 260), go_on(env, 260))


def test_a_vector_environment_can_be_made_from_the_specification_of_a_single_environment():
    spec = gym.make(ID, episode_steps=5, **EKF).spec
    assert gym.make_vec(spec, num_envs=3).reset(seed=0)[0].shape[0] == 3
    with refuses("max_episode_steps"):
        gym.make_vec(spec, num_envs=3, max_episode_steps=9)


CORRECTION = {"beliefs": "per-mode", "action": "correction"}
# argument -> first word of its error, if this is not the argument ("": any word)
NAMED = {"episodes": "", "terminate_on_divergence": "", "modes": "mode"}


@pytest.mark.parametrize(
    "arguments",
    [
        {"modes": []},
        {"backend": "matlab"},
        {"dt": 0.0},
        {"dt": "1"},
        {"episode_steps": 0},
        {"episode_steps": 2**40},
        {"max_episode_steps": 5},
        {"planar": "x"},
        {"observation": None},
        {"render_mode": "rgb_array", "render_size": 480.0},
        {"modes": {"ekf", "ukf"}},  # a set has no order
        {"episodes": "canyon28_vehicle", "episode_steps": 10_000},
        {"episodes": "canyon28_vehicle", "scenario": "jam"},
        {"episodes": "canyon28_vehicle", "scene": "o1"},
        {"episodes": "canyon28_vehicle", "dt": 1.0},
        {"episodes": "canyon28_vehicle", "odometry": True},
        {"reward": lambda belief, truth: 0.0, "terminate_on_divergence": True},
        {"reward": LogScore(math.nan), "terminate_on_divergence": True},
        {**CORRECTION, "base": lambda table: None},
        {**CORRECTION, "reward": "paired", "terminate_on_divergence": True},
    ],
    ids=lambda arguments: ", ".join(arguments),
)
def test_the_error_about_a_wrong_argument_names_it(arguments):
    *_, name = arguments
    with refuses(NAMED.get(name, name)):
        gym.make(ID, **arguments)


@pytest.mark.parametrize("options", [5, "episode_key", []])
def test_options_that_are_not_a_dict_are_refused(options):
    for env in (gym.make(ID), gym.make_vec(ID, num_envs=2)):
        with refuses("options"):
            env.unwrapped.reset(options=options)


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
@pytest.mark.parametrize("name", ["frameskip", "epsiode_steps", "data"])
def test_an_unknown_argument_raises_the_usual_error_of_python(make, name):
    """Check the exact message, which makes TorchRL try again without `frameskip`."""
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{name}'"):
        make(ID, **{name: 1})
