"""Tests of the environment MmWaveLoc-v0. They also run without PyTorch and on Gymnasium 1.1."""

import inspect
import math
import warnings
from dataclasses import fields, replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env
from numpy.testing import assert_allclose

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.env import MmWaveLocEnv
from mmwave_env.filters import Mode
from mmwave_env.filters.bank import modes_from
from mmwave_env.models.radio import RADIOS
from mmwave_env.task import TaskArguments
from mmwave_env.world.mobility import MOBILITIES
from tests.environment.vector_checker import assert_own_memory, same
from tests.filters.tracks import replay, seeded
from tests.refusals import refuses

ID = "MmWaveLoc-v0"
EKF = {"modes": ["ekf"]}  # a single mode compiles fastest

STEP_KEYS = {"position_error_m", "nees", "nis", "accepted", "rejected", "mode", "gamma"}
STEP_KEYS |= {"truth", "estimate", "reward_terms", "cost"}
END_KEYS = {"ate_m", "rmse_m", "rpe_m", "mean_nees", "in_bounds", "divergence"}


def adrift(drift_mps, epochs=200):
    """Return a source of an episode without measurements, so that the belief only drifts.

    The user rests, but the prior's mean has the speed ``drift_mps``.
    """
    episode = seeded(0, epochs=epochs)
    position = np.tile(episode.truth_position_m[0], (epochs, 1))
    return replay(
        replace(
            episode,
            visible=np.zeros_like(episode.visible),
            truth_position_m=position,
            truth_velocity_mps=np.zeros_like(position),
            prior_mean=np.array([*position[0], drift_mps, 0.0, 0.0, 0.0]),
        )
    )


def roll(env, seed=0, steps=200):
    """Play an episode in which the modes take turns; return the results of its steps."""
    env.reset(seed=seed)
    done = []
    for t in range(steps):
        done.append(env.step(np.int64(t % env.action_space.n)))
        if done[-1][2] or done[-1][3]:
            break
    return done


# --- checkers and registration

ROBUST = Mode("robust", robust=True, blockage_aware=True, cost=0.1)
CONFIGURATIONS = {
    "default": {},
    "vehicle": {"scenario": "vehicle", "radio": "standard", "scene": "o1"} | EKF,
    "prior": {"observation": "prior", "reward": "log-score"} | EKF,
    "signed": {"beliefs": "per-mode", "observation": "signed", "modes": ["ekf", "ukf"]},
    "flat": {"planar": True, "odometry": True, "dt": 0.5} | EKF,
    "own modes": {"modes": [ROBUST, Mode("re-acquire", gate=None, recovery=None)]},
    "recorded": {"episodes": "canyon28_vehicle", "episode_steps": 40} | EKF,
    "filterpy": {"backend": "filterpy", "episode_steps": 5} | EKF,
    "ends early": {"terminate_on_divergence": True, "episode_steps": 30} | EKF,
}


@pytest.fixture(params=CONFIGURATIONS)
def configuration(request):
    return CONFIGURATIONS[request.param]


def test_the_environment_passes_gymnasium_s_checker(configuration, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(ID, disable_env_checker=True, **configuration)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def test_the_docstring_explains_every_argument_and_every_key_of_infos():
    page = inspect.cleandoc(MmWaveLocEnv.__doc__)
    arguments = page.split("## Arguments")[1].split("## Vectorized")[0]
    own = {*inspect.signature(MmWaveLocEnv._begin).parameters} - {"self", "arguments"}
    for name in ("env_config", *own, *(field.name for field in fields(TaskArguments))):
        assert f"`{name}`" in arguments
    information = page.split("## Information")[1].split("## Arguments")[0]
    for key in STEP_KEYS | END_KEYS | {"episode_name", "episode_key", "nonfinite"}:
        assert f"`{key}`" in information
    for radio in RADIOS:
        for mode, row in zip(modes_from(None, radio), page.split("\n| ")[2:], strict=False):
            assert f" {mode.sigma_v:.2f} {radio}" in row


def test_a_mapping_of_arguments_as_rllib_passes_it_may_be_followed_by_others():
    env = MmWaveLocEnv({"scenario": "jam", "episode_steps": 7}, radio="standard")
    assert env.radio.name == "standard" and env.source.epochs == 7
    with pytest.raises(TypeError, match="multiple values.*'scenario'"):
        MmWaveLocEnv({"scenario": "jam"}, scenario="vehicle")
    with refuses("scenery", error=TypeError):
        MmWaveLocEnv({"scenery": "vehicle"})


def test_the_same_seed_gives_the_same_episode(configuration):
    first = gym.make(ID, **configuration)
    again = gym.make(ID, **configuration)
    assert same(first.reset(seed=3), again.reset(seed=3))
    played = roll(first, seed=3, steps=20)
    other = roll(again, seed=4, steps=20)[-1]
    assert same(played, roll(again, seed=3, steps=20))
    assert not np.array_equal(other[0], played[-1][0])


# --- steps


@pytest.mark.parametrize(
    "action", [2, -1, np.int64(7), 0.0, np.float64(0.0), np.nan, None, "ekf", np.array([0, 1])]
)
def test_a_bad_action_is_refused_and_changes_nothing(action):
    env = gym.make(ID)
    twin = gym.make(ID)
    env.reset(seed=0)
    twin.reset(seed=0)
    with refuses("action", error=InvalidAction):
        env.step(action)
    assert same(env.step(np.int64(1)), twin.step(np.int64(1)))


@pytest.mark.parametrize("action", [0, np.int64(1), np.int32(0), np.uint8(1), np.array(1)])
def test_any_type_of_integer_in_range_is_accepted_as_action(action):
    env = gym.make(ID)
    env.reset(seed=0)
    assert env.step(action)[-1]["mode"] == int(action)


def test_a_step_before_reset_or_after_the_end_is_refused_until_reset():
    env = gym.make(ID, episode_steps=3, **EKF).unwrapped
    for _ in range(2):
        with pytest.raises(ResetNeeded):
            env.step(0)
        assert len(roll(env)) == 3


@pytest.mark.parametrize("episode_steps", [None, 1, 250])
def test_an_episode_is_truncated_after_the_given_number_of_steps(episode_steps):
    env = gym.make(ID, episode_steps=episode_steps, **EKF)
    done = roll(env, steps=1000)
    assert len(done) == (episode_steps or 200)
    assert not any(terminated for _, _, terminated, _, _ in done)
    assert [truncated for *_, truncated, _ in done] == [False] * (len(done) - 1) + [True]
    assert all(math.isfinite(value) for value in (done[-1][4][key] for key in END_KEYS))


def test_infos_have_the_documented_keys_types_and_shapes():
    env = gym.make(ID, episode_steps=5)
    _, info = env.reset(seed=0)
    assert set(info) == {"episode_name", "episode_key", "nonfinite", "truth", "estimate"}
    assert info["episode_name"] in MOBILITIES
    assert info["nonfinite"] == 0
    done = roll(env)
    for *_, info in done[:-1]:
        assert set(info) == STEP_KEYS
    assert set(done[-1][-1]) == STEP_KEYS | END_KEYS
    for t, (*_, info) in enumerate(done):
        assert info["mode"] == t % 2
        assert info["nis"].shape == info["accepted"].shape == info["rejected"].shape == (4,)
        assert info["accepted"].dtype == info["rejected"].dtype == bool
        assert not (info["accepted"] & info["rejected"]).any()
        assert info["truth"].shape == (6,) and info["estimate"].shape == (7,)
        assert 0.5 <= info["gamma"] <= 2.0 and info["nees"] >= 0.0
        error = np.linalg.norm(info["estimate"][:3] - info["truth"][:3])
        assert info["position_error_m"] == pytest.approx(error, abs=1e-9)


@pytest.mark.parametrize("planar", [False, True])
def test_the_belief_belongs_to_the_last_epoch(planar):
    env = gym.make(ID, planar=planar, **EKF).unwrapped
    with pytest.raises(ResetNeeded):
        env.belief()
    env.reset(seed=0)
    for _ in range(3):
        *_, info = env.step(0)
    belief = env.belief()
    assert belief.x == info["estimate"].tolist()
    assert belief.nees(info["truth"].tolist()) == pytest.approx(info["nees"])


def test_nonfinite_measurements_are_counted_in_info():
    episode = seeded(0)
    measurement = episode.measurement.copy()
    epochs, links = np.argwhere(episode.visible[:, :3])[:5].T
    measurement[epochs, 4 * links] = np.nan
    env = gym.make(ID, episodes=replay(replace(episode, measurement=measurement)), **EKF)
    assert env.reset(seed=0)[1]["nonfinite"] == 5
    assert all(np.isfinite(obs).all() and math.isfinite(r) for obs, r, *_ in roll(env))


def test_returned_arrays_share_no_memory_with_the_environment():
    env = gym.make(ID)
    twin = gym.make(ID)
    assert_own_memory([env.reset(seed=0), *(env.step(np.int64(t % 2)) for t in range(5))])
    roll(twin, steps=5)
    assert same(env.step(np.int64(1)), twin.step(np.int64(1)))


# --- arguments


@pytest.mark.parametrize("odometry", [False, True])
def test_the_height_is_constant_on_flat_terrain(odometry):
    env = gym.make(ID, planar=True, odometry=odometry, **EKF)
    for seed in range(5):
        env.reset(seed=seed)
        for *_, info in roll(env, seed=seed):
            assert_allclose(info["estimate"][[2, 5]], [1.5, 0.0], atol=1e-12)
    assert info["nees"] < 1e3


# --- the end of an episode


def alive_and_ended(source):
    """Return the steps of an episode that goes on after divergence, and of one that ends."""
    return [
        roll(gym.make(ID, episodes=source, terminate_on_divergence=ends, **EKF))
        for ends in (False, True)
    ]


def test_divergence_gives_the_worst_reward_for_every_remaining_epoch():
    source = adrift(drift_mps=4.9)
    surviving, ended = alive_and_ended(source)
    assert len(surviving) == 200 and len(ended) == 12  # 53.9 m off after 11 s of drift
    assert same(ended[:-1], surviving[:11])
    _, reward, terminated, truncated, info = ended[-1]
    assert terminated and not truncated
    assert reward == pytest.approx(surviving[11][1] - 10.6 * 188)  # the worst reward is -10.6
    assert set(info) == STEP_KEYS | END_KEYS and info["divergence"] == 1.0


@pytest.mark.parametrize("cost", [0.0, 1.0])
@pytest.mark.parametrize("drift_mps", [1.0, 40.0])
def test_ending_on_divergence_never_gives_a_larger_return_than_continuing(cost, drift_mps):
    source = adrift(drift_mps=drift_mps)
    modes = [Mode("ekf", sigma_v=0.3, cost=cost)]
    returns = [
        sum(reward for _, reward, *_ in roll(gym.make(ID, episodes=source, modes=modes, **end)))
        for end in ({"terminate_on_divergence": True}, {})
    ]
    assert returns[0] <= returns[1] + 1e-9  # rounding errors of a sum of 200 rewards


def test_divergence_in_the_last_epoch_does_not_change_the_reward():
    source = adrift(drift_mps=4.9, epochs=12)
    (*_, plain), (*_, last) = alive_and_ended(source)
    assert last[1] == plain[1] and last[2] and not last[3]


@pytest.mark.parametrize("unknown", ["truth_position_m", "truth_velocity_mps"])
def test_an_episode_without_true_positions_or_velocities_is_refused(unknown):
    env = gym.make(ID, episodes=replay(replace(seeded(0), **{unknown: None})), **EKF)
    with refuses("episode"):
        env.reset(seed=0)
