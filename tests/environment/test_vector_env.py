"""Tests that the vector environment obeys Gymnasium's rules and equals single environments."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import mmwave_env.engines.batch as batch
from mmwave_env.datasets.samples import sample_folder
from mmwave_env.filters import Mode
from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.vector_env import MmWaveLocVectorEnv
from mmwave_env.world.simulated import SimulatedSource
from tests.environment.vector_checker import check_memory, rollout, same
from tests.filters.tracks import street_source
from tests.paths import representative
from tests.refusals import refuses

ID = "MmWaveLoc-v0"
EKF = {"modes": ["ekf"]}
STAY = np.zeros(3, int)  # actions
FIRST = {"reset_mask": np.array([True, False, False])}
every_mode = pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])


class Patchy:
    """A source of episodes with 2 to 7 epochs, missing links and NaN measurements."""

    layout = Layout(3)
    name = "patchy"

    def sample(self, rng):
        rng, _ = rng.spawn(2)
        epochs = int(rng.integers(2, 8))
        episode = street_source(epochs=epochs).sample(rng)
        measurement = episode.measurement.copy()
        measurement[rng.random(measurement.shape) < 0.05] = np.nan
        return replace(episode, measurement=measurement, visible=rng.random((epochs, 4)) < 0.6)


class Twice(SimulatedSource):
    """A source that draws two episodes and returns the second."""

    def sample(self, rng):
        super().sample(rng)
        return super().sample(rng)


# This filter assumes that users never change their speed, and so it loses track of most cars.
STUBBORN = Mode("ekf", sigma_v=1e-3, sigma_p=1e-3, adaptive=False, recovery=None)
PER_MODE = {"beliefs": "per-mode", "modes": ["ekf", "ukf"]}
LOSING = {"scenario": "vehicle", "modes": [STUBBORN]}
OWN = {"modes": ["ckf", Mode("robust", robust=True, cost=0.1), "ekf"]}
SHORT = {"episode_steps": 6}
BAD = {"episode_steps": 7, "clock": "free", "survey": "bad"}
CONFIGURATIONS = {
    "default": SHORT,
    "one step": {"episode_steps": 1} | EKF,
    "flat": {"episode_steps": 7, "planar": True, "odometry": True, "dt": 0.5} | EKF,
    "own modes": {"episode_steps": 5, "scenario": "jam", "radio": "high", "scene": "o1"} | OWN,
    "prior": {"episode_steps": 12, "observation": "prior", "reward": "log-score"} | EKF,
    "per mode": SHORT | PER_MODE,
    "some rows": {"measurements": ["range", "azimuth"], "reward": "paired"} | SHORT | PER_MODE,
    "clock": {"clock": "offset", "reward": "paired"} | SHORT | EKF,
    "clock per mode": {"episode_steps": 7, "clock": "offset"} | PER_MODE,
    "badly surveyed": BAD | EKF,
    "badly surveyed per mode": BAD | PER_MODE,
    "recorded": {"episodes": "canyon28_pedestrian", "episode_steps": 11} | EKF,
    "log": {"episodes": sample_folder("canyon28_vehicle"), "episode_steps": 11} | EKF,
    "patchy": {"episodes": Patchy()},
    "twice": {"episodes": Twice(SCENES["street"], RADIOS["handset"], epochs=4)} | EKF,
    "ends early": {"episode_steps": 14, "terminate_on_divergence": True} | LOSING,
}
CONFIGURATIONS["paired"] = CONFIGURATIONS["ends early"] | {"reward": "paired"}
SLOW = {"one step", "own modes", "prior", "clock per mode", "log", "patchy", "twice"}
QUICK = CONFIGURATIONS.keys() - SLOW


def native(n=9, mode="NextStep", **arguments):
    return gym.make_vec(ID, num_envs=n, autoreset_mode=mode, **arguments)


def sync(n, mode="NextStep", **arguments):
    return gym.make_vec(
        ID,
        num_envs=n,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": AutoresetMode(mode)},
        **arguments,
    )


# --- Gymnasium's rules


@every_mode
@pytest.mark.parametrize("name", representative(CONFIGURATIONS, "recorded"))
def test_results_share_no_memory(name, mode):
    check_memory(lambda: native(9, mode, **CONFIGURATIONS[name]))


def test_make_vec_makes_the_native_vector_environment_without_warnings():
    env = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=3, **EKF)
    assert isinstance(env, MmWaveLocVectorEnv) and env.num_envs == 3
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert MmWaveLocVectorEnv.metadata.get("autoreset_mode") is None
    assert env.single_observation_space == gym.make(ID, **EKF).observation_space
    assert env.observation_space == batch_space(env.single_observation_space, 3)
    assert env.action_space == batch_space(env.single_action_space, 3)
    for _ in range(2):
        env.close()
        assert env.closed


def test_a_vector_environment_can_be_made_from_its_specification_in_json():
    env = native(5, "SameStep", scenario="vehicle", episode_steps=4)
    again = gym.make_vec(EnvSpec.from_json(env.spec.to_json()))
    assert same(rollout(env, seed=1, steps=9), rollout(again, seed=1, steps=9))


@every_mode
@pytest.mark.parametrize("name", representative(CONFIGURATIONS, *QUICK))
def test_the_native_vector_environment_equals_the_synchronous_environment(mode, name):
    configuration = CONFIGURATIONS[name]
    ours = rollout(native(9, mode, **configuration), 4, 50)
    expected = rollout(sync(9, mode, **configuration), 4, 50)
    for t, (a, b) in enumerate(zip(ours, expected, strict=True)):
        assert same(a, b), f"step {t}"
    steps = [step for step in expected if len(step) == 5]
    assert all(np.isfinite(step[1]).all() for step in steps)
    over = sum(step[2].astype(int) + step[3] for step in steps)
    assert over.min() >= 3
    if "terminate_on_divergence" in configuration:
        assert sum(step[2].sum() for step in steps) >= 3


@pytest.mark.parametrize("n", [1, 7, 8, 20])
def test_a_vector_of_n_environments_equals_n_single_environments(n):
    arguments = CONFIGURATIONS["patchy"]
    assert same(*(rollout(make(n, **arguments), 7, 40) for make in (native, sync)))


@every_mode
def test_the_number_of_threads_does_not_matter(mode, monkeypatch):
    monkeypatch.setattr(batch, "BLOCKS_PER_THREAD", 1)
    arguments = CONFIGURATIONS["ends early"]
    first, *others = [
        rollout(native(75, mode, threads=threads, **arguments), 4, 50) for threads in (1, 2, 5)
    ]
    for other in others:
        assert same(first, other)


def test_a_masked_reset_equals_a_masked_reset_of_synchronous_environments():
    mask = np.arange(9) % 3 == 0
    actions = np.zeros(9, np.int64)
    ours = native(9, "Disabled", episode_steps=5, **EKF)
    theirs = sync(9, "Disabled", episode_steps=5, **EKF)
    for seed in (None, list(range(100, 109))):  # None continues with the next episodes
        results = []
        for env in (ours, theirs):
            env.reset(seed=0)
            env.step(actions)
            reset = env.reset(seed=seed, options={"reset_mask": mask.copy()})
            drawn = [rng.random() for rng in env.np_random]
            results.append([reset, env.np_random_seed, drawn, env.step(actions)])
        assert same(*results)
    for wrong in (np.zeros(9, bool), np.ones(10, bool), np.ones(9), [True] * 9):
        with pytest.raises((AssertionError, TypeError, ValueError)):
            ours.reset(options={"reset_mask": wrong})


# --- arguments and mistakes


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("num_envs", "3"),
        ("threads", 0),
        ("autoreset_mode", "same"),
        ("render_mode", "human"),
        ("backend", "filterpy"),
        ("max_episode_steps", 9),
        ("observation", "none"),
    ],
)
def test_wrong_arguments_are_refused(name, value):
    with refuses(name):
        gym.make_vec(ID, **{name: value})


@pytest.mark.parametrize(
    "actions",
    [[0, 2, 0], [0, -1, 0], [0, 1], 1, None, [0.0, 1.0, 0.0], [True, False, True], [[0], [1], [0]]],
    ids=repr,
)
def test_bad_actions_are_refused_and_change_nothing(actions):
    env = native(3)
    twin = native(3)
    for each in (env, twin):
        each.reset(seed=0)
    with refuses("actions", error=InvalidAction):
        env.step(np.array(actions))
    good = np.array([0, 1, 1], np.int32)
    assert same(env.step(good), twin.step(good))


@pytest.mark.parametrize("action", [-5, 999, -(2**40)])
def test_the_action_of_a_resetting_environment_is_ignored(action):
    env = native(3, episodes=Patchy())
    twin = native(3, episodes=Patchy())
    for each in env, twin:
        each.reset(seed=0)
    over = np.zeros(3, bool)
    for step in range(40):
        chosen = np.full(3, step % 2)
        result = env.step(np.where(over, action, chosen))
        expected = twin.step(np.where(over, 0, chosen))
        assert same(result, expected)
        over = result[2] | result[3]
    with pytest.raises(InvalidAction):
        env.step(np.where(over, 0, action))


def test_a_step_before_reset_is_refused():
    env = native(3, **EKF)
    with pytest.raises(ResetNeeded):
        env.step(STAY)
    with pytest.raises(ResetNeeded):
        env.reset(options=FIRST)


def test_a_step_after_a_failed_reset_is_refused(monkeypatch):
    env = native(3, **EKF)
    env.reset(seed=0)
    with monkeypatch.context() as patch:
        patch.setattr(env.unwrapped.source.__class__, "begin", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            env.reset(seed=1)
    with pytest.raises(ResetNeeded):
        env.step(STAY)
    env.reset(seed=1)
    env.step(STAY)


def test_the_error_about_a_step_after_the_end_names_the_environments():
    env = native(3, "Disabled", episode_steps=1, **EKF)
    env.reset(seed=0)
    env.step(STAY)
    env.reset(options=FIRST)
    with pytest.raises(ResetNeeded, match=r"environments \[1, 2\] are over.*reset_mask"):
        env.step(STAY)


@pytest.mark.parametrize("seed", [[1, 2], -1, [1, 2, -3], 1.5, "abc", np.array([0.0, 1.0, 2.0])])
def test_wrong_seeds_are_refused_and_seed_nothing(seed):
    env = native(3, **EKF)
    with refuses("seed"):
        env.reset(seed=seed)
    assert env.np_random_seed == (-1, -1, -1)


@pytest.mark.parametrize("keys", [[1, 2], 7, [[1, 2, 3]]])
def test_episode_keys_of_a_wrong_shape_are_refused(keys):
    with refuses("episode_key"):
        native(3, **EKF).reset(options={"episode_key": keys})
