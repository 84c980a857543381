"""Tests of beliefs that become NaN: they are counted and cause warnings, and averages are NaN."""

import math

import gymnasium as gym
import numpy as np
import pytest

from experiments.evaluation.compare import compare_scores
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.runner import score_contenders
from mmwave_env.filters import Mode, ekf
from mmwave_env.numerics.numbers import where
from policies import FixedMode
from tests.filters.tracks import street_source

ID = "mmwave_env:MmWaveLoc-v0"
STEPS = 15
KEY = "nonfinite_beliefs"


def rotten(x, P, measurement, gate):
    """Update as an EKF does, but return a NaN belief if the first link's NIS is from 20 to 90."""
    after = ekf(x, P, measurement, gate)
    lost = where(after.nis[0] > 20.0, math.nan, 0.0)
    # Before compilation, a function is tried on an outlier with NIS > 90 and must not return NaN.
    lost = where(after.nis[0] > 90.0, 0.0, lost)
    return after._replace(x=[after.x[0] + lost, *after.x[1:]])


TASK = {"modes": [Mode("rotten", rotten)], "episode_steps": STEPS, "radio": "standard"}


def rolled(env, seed):
    """Return the rewards and the infos of the steps of an episode."""
    env.reset(seed=seed)
    _, rewards, *_, infos = zip(*(env.step(0) for _ in range(STEPS)), strict=True)
    return rewards, infos


def test_the_last_info_counts_the_epochs_with_a_nan_belief_and_a_warning_is_given():
    env = gym.make(ID, **TASK)
    counts = []
    with pytest.warns(RuntimeWarning, match=KEY):
        rolls = [rolled(env, seed) for seed in range(6)]
    for rewards, infos in rolls:
        lost = [not np.isfinite(info["nees"]) for info in infos]
        assert infos[-1].get(KEY, 0) == sum(lost)
        assert not any(KEY in info for info in infos[:-1])
        assert (np.array(rewards)[lost] == env.unwrapped.reward.worst).all()
        counts.append(sum(lost))
    assert min(counts) == 0 and max(counts) > 0


@pytest.mark.filterwarnings("ignore:the belief was NaN:RuntimeWarning")
@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep", "Disabled"])
def test_the_vector_environment_counts_nan_beliefs_as_single_environments_do(autoreset):
    n = 6
    single = gym.make(ID, **TASK)
    env = gym.make_vec(ID, num_envs=n, autoreset_mode=autoreset, **TASK)
    env.reset(seed=0)
    for _ in range(STEPS):
        *_, infos = env.step(np.zeros(n, np.int64))
    infos = infos.get("final_info", infos)
    expected = [rolled(single, seed)[1][-1].get(KEY, 0) for seed in range(n)]
    assert infos[KEY].tolist() == expected
    assert infos[f"_{KEY}"].tolist() == [count > 0 for count in expected]


@pytest.mark.slow
def test_a_comparison_includes_episodes_with_nan_beliefs_and_names_the_policy():
    source = street_source(radio="standard", epochs=STEPS)
    chosen = Contender(tuple(TASK["modes"]), policy=lambda table: FixedMode(0), name="mine")
    ekf = contender_from("fixed-ekf", "standard")
    seeds = range(6)
    with pytest.warns(RuntimeWarning, match=r"^mine: [1-5] of 6 episodes .* NaN or infinite"):
        scores = score_contenders([chosen, ekf], source, seeds)
    lost = np.isnan(scores["mine"]["nees"])
    assert 0 < np.count_nonzero(lost) < 6
    assert (scores["mine"]["divergence_rate"][lost] == 1.0).all()
    comparison = compare_scores(scores, scenario="mixed", radio="standard", seeds=seeds)
    assert np.isnan(comparison.policies["mine"]["ate_m"].mean)
    row = next(line for line in str(comparison).splitlines() if line.startswith("| mine"))
    assert "nan" in row
    assert np.isfinite(comparison.policies["fixed-ekf"]["ate_m"].mean)
