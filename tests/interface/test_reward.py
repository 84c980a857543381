"""Tests of shipped, custom and paired rewards; a paired reward is relative to an IMM's reward."""

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.stats import multivariate_normal

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.engines.engine import run_imm
from mmwave_env.filters import Mode
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.filters.belief import Belief
from mmwave_env.interface.reward import (
    REWARDS,
    LogScore,
    PairedReward,
    TrackingReward,
    reward_from,
    reward_name,
    terms_of,
    total,
)
from mmwave_env.numerics.numbers import log, maximum, sqrt, where
from mmwave_env.task import task_from
from mmwave_env.world.keys import keys_at, stream_of
from tests.environment.test_env import roll
from tests.refusals import refuses
from tests.training.actors import MODES

ORIGIN = [0.0] * 6


def belief(error_m=(0.0, 0.0, 0.0), variance_m2=1.0, axes=(0, 1, 2)):
    """Return a belief about a user at the origin, with the same variance along all axes."""
    P = (variance_m2 * np.eye(7)).tolist()
    return Belief([*map(float, error_m), 0.0, 0.0, 0.0, 0.0], P, axes)


def pays(reward, belief):
    """Return the value of a reward for a belief about a user at the origin."""
    return total(terms_of(reward(belief, ORIGIN)))


def test_shipped_rewards_have_names_and_others_are_named_after_their_class_or_function():
    for name, reward in REWARDS.items():
        assert reward_name(reward) == name
    assert reward_name(TrackingReward(error_limit_m=5.0)) == "TrackingReward"
    assert reward_name(belief) == "belief"


# First case: an error of 3 m with variances of 1 m^2 gives NEES 9 and |ln(9 / 3)| = 1.0986.
@pytest.mark.parametrize(
    ("error_m", "variance_m2", "expected"),
    [
        ((0.0, 3.0, 0.0), 1.0, -(3.0 + 0.2 * 1.0986122886681098)),
        ((2.0, 1.0, 2.0), 3.0, -3.0),  # NEES 3, the expected value
        ((1.0, 0.0, 0.0), 4.0, -(1.0 + 0.2 * math.log(12.0))),
        ((6.0, 8.0, 0.0), 100.0 / 3.0, -10.0),
        ((60.0, 80.0, 0.0), 10000.0 / 3.0, -10.0),  # the error is limited to 10 m
        ((0.0, 0.0, 0.0), 1.0, -0.6),  # |ln(NEES / 3)| is limited to 3
        ((1e3, 0.0, 0.0), 1e-3, -10.6),
    ],
)
def test_the_tracking_reward_equals_values_computed_by_hand(error_m, variance_m2, expected):
    assert pays(TrackingReward(), belief(error_m, variance_m2)) == pytest.approx(expected)


def test_on_flat_ground_the_expected_nees_is_2():
    assert pays(TrackingReward(), belief((2.0, 0.0, 0.0), 2.0, (0, 1))) == pytest.approx(-2.0)


@pytest.mark.parametrize(
    "reward", [TrackingReward(), TrackingReward(2.0, 5.0, 1.0, 0.5), LogScore(), LogScore(-7.0)]
)
def test_a_reward_is_never_below_its_worst_value(reward):
    for error in (0.0, 1.0, 1e3, 1e6):
        for variance in (1e-6, 1.0, 1e6):
            assert pays(reward, belief((error, error, error), variance)) >= reward.worst
    assert pays(reward, belief((1e6, 0.0, 0.0), 1e-6)) == reward.worst


@settings(derandomize=True)
@given(
    hnp.arrays(float, (7, 7), elements=st.floats(-1.0, 1.0)),
    hnp.arrays(float, 3, elements=st.floats(-5.0, 5.0)),
    st.sampled_from([(0, 1, 2), (0, 1)]),
)
def test_log_score_is_the_log_density_of_the_truth(root, error, axes):
    P = root @ root.T + 0.1 * np.eye(7)
    x = np.concatenate([error, np.zeros(4)])
    at = list(axes)
    expected = multivariate_normal(x[at], P[np.ix_(at, at)]).logpdf(np.zeros(len(at)))
    score = pays(LogScore(worst=-1e6), Belief(x.tolist(), P.tolist(), axes))
    assert score == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_a_reward_is_given_by_name_or_as_a_function():
    assert reward_from("tracking") == TrackingReward() and reward_from("log-score") == LogScore()
    assert reward_from(capped) is capped
    assert reward_from("paired") == PairedReward(TrackingReward())
    assert reward_from(PairedReward(capped)).reward is capped
    for unknown in ("speed", PairedReward(PairedReward()), lambda belief, truth: {"cost": 0.0}):
        with refuses("reward"):
            reward_from(unknown)


def capped(belief, truth):
    return maximum(-belief.distance(truth), -2.0)


PRICED = [Mode("free", sigma_v=0.3), Mode("paid", sigma_v=1.8, cost=0.25)]


def weighed(belief, truth):
    """Return a reward with two terms."""
    error = belief.error(truth)
    return {"east": -abs(error[0]), "north": -2.0 * abs(error[1])}


@pytest.mark.parametrize("beliefs", ["shared", "per-mode"])
def test_infos_contain_the_terms_that_add_up_to_the_reward(beliefs):
    task = {"modes": PRICED, "reward": weighed, "beliefs": beliefs, "episode_steps": 12}
    env = gym.make("MmWaveLoc-v0", **task)
    assert env.unwrapped.reward_terms == ("east", "north", "cost")
    env.reset(seed=0)
    for t in range(12):
        action = t % env.action_space.n
        _, reward, _, _, info = env.step(action)
        east, north, cost = info["reward_terms"]
        assert reward == pytest.approx(east + north + cost, abs=1e-12)
        error = np.abs(info["estimate"][:2] - info["truth"][:2])
        assert [east, north] == pytest.approx(-error * [1.0, 2.0], abs=1e-12)
        assert cost == (-0.25 if env.unwrapped.observation.actions[action] == "paid" else 0)
    assert east < 0.0 and north < 0.0


def branch(belief, truth):
    return 0.0 if belief.distance(truth) < 1.0 else -1.0


@pytest.mark.parametrize(
    "own",
    [
        branch,
        lambda belief, truth: np.sqrt(belief.nees(truth)),
        lambda belief, truth: None,
        lambda belief, truth: belief.distance(truth) > 1.0,
        lambda belief, truth: {"error": None},
        lambda belief, truth: {"error": -belief.distance(truth), "bonus": math.nan},
        lambda belief, truth: log(-belief.distance(truth)),  # 1420 on lanes
        lambda belief, truth: 10**400,
    ],
)
def test_the_error_about_an_invalid_reward_function_names_its_file(own):
    with pytest.raises(ValueError, match=rf"^reward {own.__name__} (?s:.)*{Path(__file__).name}"):
        gym.make("MmWaveLoc-v0", reward=own)


def test_a_reward_may_guard_a_branch_that_has_no_value():
    def shaped(belief, truth):
        near = 1.0 - belief.distance(truth)
        return where(near > 0.0, sqrt(near), 0.0)

    assert reward_from(shaped) is shaped


SLUGGISH = Mode("sluggish", sigma_v=0.05)  # diverges in about half of all vehicle episodes
DIVERGING = {"scenario": "vehicle", "episode_steps": 40, "modes": [SLUGGISH]}


def imm_rewards(seed, episodes, reward, **task):
    """Return the IMM's rewards (episodes, epochs) in the first episodes of a seed."""
    bank = Bank(default_modes("handset"))
    keys = keys_at(stream_of(seed), np.arange(episodes, dtype=np.uint64))
    drawn = task_from(**task).simulated.sample_batch(keys)
    imm = run_imm(bank, reward, drawn, "reward", planar=task.get("planar", False))
    return imm["reward"].astype(np.float32)


@pytest.mark.parametrize(
    ("reward", "task"),
    [
        (TrackingReward(), {"modes": MODES, "scenario": "vehicle", "episode_steps": 7}),
        pytest.param(
            capped,
            {"modes": ["ekf"], "planar": True, "odometry": True, "episode_steps": 5},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["three modes", "own reward on flat ground"],
)
def test_paired_rewards_are_rewards_minus_the_imms_rewards_in_the_same_episodes(reward, task):
    """Check equality to the last bit; the agent's modes differ from the IMM's modes."""
    n = 5
    epochs = 3 * task["episode_steps"]
    envs = [
        gym.make_vec("MmWaveLoc-v0", num_envs=n, autoreset_mode="SameStep", reward=each, **task)
        for each in (reward, PairedReward(reward))
    ]
    for env in envs:
        env.reset(seed=3)
    baseline = np.array([imm_rewards(3 + i, 3, reward, **task).ravel() for i in range(n)])
    rng = np.random.default_rng(0)
    for t in range(epochs):
        actions = rng.integers(len(task["modes"]), size=n)
        tracked, paired = (env.step(actions)[1] for env in envs)
        np.testing.assert_array_equal(paired, tracked.astype(np.float32) - baseline[:, t])
    assert np.abs(baseline).min() > 0.0


def test_a_paired_return_is_the_return_minus_the_imms_return_even_if_an_episode_ends_early():
    ended = 0
    for seed in range(12):
        returns = []
        for reward in ("paired", "tracking"):
            task = DIVERGING | {"reward": reward, "terminate_on_divergence": True}
            env = gym.make("MmWaveLoc-v0", **task)
            steps = roll(env, seed)
            returns.append(sum(now for _, now, *_ in steps))
            ended += steps[-1][2]
        paired, tracking = returns
        imm = imm_rewards(seed, 1, REWARDS["tracking"], **DIVERGING).sum(dtype=float)
        assert paired == pytest.approx(tracking - imm, rel=1e-5)
    assert 3 <= ended / 2 <= 9
