"""Tests of continuous actions: weights of the modes, and corrections of the belief."""

import copy
import math
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import InvalidAction
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_allclose

from mmwave_env.engines.vector_step import exceeds
from mmwave_env.localization.position_errors import horizontal_level
from mmwave_env.metrics import RISK
from tests.environment.test_vector_env import ID, PER_MODE, native, sync
from tests.environment.vector_checker import forward, same
from tests.refusals import refuses


def alternating(table):
    """Return a base policy, which chooses modes (none, ekf or ukf) before beliefs are corrected."""
    column = table.names.index("coming NIS anchor 1 ukf")
    return lambda shown: np.digitize(shown[:, column], [-0.5, 0.5])


KINDS = {  # arguments of environments with continuous actions
    "weights": PER_MODE | {"action": "weights"},
    "correction": PER_MODE | {"action": "correction"},
    "base": PER_MODE | {"action": "correction", "base": alternating},
}


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


def played(env, actions):
    """Return the results of a reset and of a step with each action."""
    return [env.reset(seed=0), *(env.step(action) for action in actions)]


def drawn(space, steps, n=()):
    """Return random actions (steps, *n, k), whose components are at most half of the limits."""
    rng = np.random.default_rng(0)
    return (rng.uniform(-0.5, 0.5, (steps, *n, *space.shape)) * space.high).astype(np.float32)


def rewards(results):
    """Return the rewards of the steps in the results of :func:`played`."""
    return np.array([result[1] for result in results[1:]])


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("weights", {"backend": "filterpy"}),
        pytest.param("correction", {"planar": True}, marks=pytest.mark.slow),
        ("base", {"backend": "filterpy"}),
    ],
)
def test_the_environment_passes_gymnasium_s_checker(name, more):
    env = gym.make(ID, episode_steps=5, disable_env_checker=True, **KINDS[name], **more)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Gymnasium recommends limits of -1 and 1, which users can get with RescaleAction.
        warnings.filterwarnings("ignore", ".*symmetric and normalized")
        check_env(env.unwrapped, skip_render_check=True)


PAIRED = {"reward": "paired", "terminate_on_divergence": True, "scenario": "vehicle"}


@pytest.mark.parametrize(
    ("name", "mode", "more"),
    [
        ("weights", "NextStep", PAIRED),
        ("correction", "SameStep", {}),
        ("base", "Disabled", {"reward": "paired"}),
    ],
)
def test_the_native_vector_environment_equals_the_synchronous_environment(name, mode, more):
    options = {"episode_steps": 9} | KINDS[name] | more
    ours = native(9, mode, **options)
    theirs = sync(9, mode, **options)
    assert ours.action_space == theirs.action_space
    assert same(ours.reset(seed=3), theirs.reset(seed=3))
    for actions in drawn(ours.single_action_space, 25, (9,)):
        assert same(forward(ours, actions), forward(theirs, actions))


def test_copies_continue_identically(kind):
    env = native(9, "SameStep", episode_steps=7, **kind)
    first, second = np.split(drawn(env.single_action_space, 20, (9,)), 2)
    played(env, first)
    twin = copy.deepcopy(env)
    expected = [env.step(actions) for actions in second]
    assert same([twin.step(actions) for actions in second], expected)


@pytest.mark.parametrize("dt", [1.0, 0.25])
def test_a_weight_of_three_has_the_effect_of_the_discrete_action_of_its_mode(dt):
    options = PER_MODE | {"episode_steps": 30, "dt": dt}
    modes = np.random.default_rng(0).integers(0, 3, 30)
    discrete = played(gym.make(ID, **options), modes)
    weights = np.vstack([np.zeros(2), 3.0 * np.eye(2)])[modes]
    weighted = played(gym.make(ID, action="weights", **options), weights)
    assert_allclose(rewards(weighted), rewards(discrete), atol=1e-9)
    assert_allclose(weighted[-1][0], discrete[-1][0], atol=1e-5)


def test_a_paired_reward_subtracts_the_reward_of_the_uncorrected_belief():
    options = KINDS["base"] | {"num_envs": 3, "episode_steps": 20}
    envs = [gym.make_vec(ID, reward=reward, **options) for reward in ("tracking", "paired")]
    actions = drawn(envs[0].single_action_space, 20, (3,))
    plain, paired = (rewards(played(env, actions)) for env in envs)
    before = rewards(played(envs[0], np.zeros_like(actions)))
    assert_allclose(paired, plain - before, atol=1e-5)


@pytest.mark.torch
def test_stable_baselines3_trains_with_continuous_actions():
    sb3 = pytest.importorskip("stable_baselines3")
    adapter = pytest.importorskip("mmwave_env.sb3")
    options = {"autoreset_mode": "SameStep", "episode_steps": 6} | KINDS["base"]
    envs = adapter.SB3VecEnv(gym.make_vec(ID, num_envs=4, **options))
    model = sb3.PPO("MlpPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, device="cpu")
    assert len(model.learn(64).ep_info_buffer) == 4 * (16 // 6)
    model = sb3.SAC("MlpPolicy", envs, learning_starts=8, batch_size=8, gamma=0.0, device="cpu")
    assert model.learn(40).num_timesteps == 40


# --- refusals


def bad(limits):
    """Yield actions with a nonfinite or too large number, a wrong shape or a wrong type."""
    for value in (math.nan, math.inf, limits[-1] * 1.001):
        yield np.append(np.zeros(len(limits) - 1), value)
    yield from (np.zeros(len(limits) + 1), np.zeros((1, len(limits))), 0, None, "none")
    yield ["a"] * len(limits)


def test_bad_actions_are_refused_and_change_nothing(kind):
    env, twin = (gym.make(ID, **kind).unwrapped for _ in range(2))
    vectors = [gym.make_vec(ID, num_envs=2, **kind) for _ in range(2)]
    good = drawn(env.action_space, 1)[0]
    for each in (env, twin, *vectors):
        each.reset(seed=0)
    for action in bad(env.action_space.high):
        with refuses("action", error=InvalidAction):
            env.step(action)
        with refuses("actions", error=InvalidAction):
            vectors[0].step([good, action] if np.shape(action) == good.shape else action)
    assert same(env.step(good), twin.step(good))
    assert same(*(each.step(np.stack([good, good])) for each in vectors))


@pytest.mark.parametrize(
    "arguments",
    [
        {"action": "numbers"},
        {"beliefs": "shared", "action": "weights"},
        {"action": "weights", "base": alternating},
        {"action": "correction", "base": "guided"},
        {"action": "correction", "observation": "prior"},
    ],
    ids=" ".join,
)
def test_unknown_and_conflicting_arguments_are_refused(arguments):
    *_, name = arguments
    for make in (gym.make, gym.make_vec):
        with refuses(name):
            make(ID, **PER_MODE | arguments)


@pytest.mark.parametrize(
    "answer", [np.array([3]), np.array([-1]), np.array([0.0]), np.zeros(2, int)]
)
def test_a_base_policy_must_return_valid_actions(answer):
    env = gym.make(ID, action="correction", base=lambda table: lambda shown: answer, **PER_MODE)
    with refuses("actions of base"):
        env.reset(seed=0)


# --- costs: 1 if the error exceeds the protection level, else 0


def test_errors_exceed_the_protection_level_of_a_belief_with_nan_or_zero_variance():
    assert exceeds(math.nan, 0.0, 1.0, 0.0, 1.0) == exceeds(1.0, 0.0, *[math.nan] * 3) == 1.0
    assert exceeds(1.0, 0.0, 0.0, 0.0, 0.0) == 1.0 and exceeds(0.0, 0.0, 0.0, 0.0, 0.0) == 0.0


@pytest.mark.parametrize("arguments", [{"modes": ["ekf"]}, KINDS["correction"]], ids=str)
def test_infos_say_whether_the_error_exceeds_the_protection_level(arguments):
    env = gym.make(ID, scenario="vehicle", **arguments).unwrapped
    env.reset(seed=1)
    costs = []
    for action in drawn(env.action_space, 200) if "action" in arguments else np.zeros(200, int):
        info = env.step(action)[4]
        belief = env.belief()
        level = horizontal_level(np.array([belief.P[0][0], belief.P[1][0], belief.P[1][1]]), RISK)
        costs.append(info["cost"])
        assert belief.x == info["estimate"].tolist()
        assert costs[-1] == float(math.hypot(*belief.error(info["truth"].tolist())[:2]) > level)
    assert 0.0 < np.mean(costs) < 0.9
