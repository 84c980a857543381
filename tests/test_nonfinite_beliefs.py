"""Beliefs that are no numbers are told, counted and warned of, never averaged away."""

import math

import gymnasium as gym
import numpy as np
import pytest

from experiments.evaluation.comparison import compare_scores
from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import score_contenders
from experiments.evaluation.seeds import Selection
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.update import ekf
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import where
from mmwave_env.world.simulated import SimulatedSource
from policies.baselines import FixedMode

ID = "mmwave_env:MmWaveLoc-v0"
STEPS, KEY = 15, "nonfinite_beliefs"


def rotten(x, P, measurement, gate):
    """An EKF whose belief is lost after a measurement that surprises it, but for a wild one."""
    after = ekf(x, P, measurement, gate)
    lost = where(after.nis[0] > 20.0, math.nan, 0.0)
    lost = where(after.nis[0] > 90.0, 0.0, lost)  # which is how algorithms are tried
    return after._replace(x=[after.x[0] + lost, *after.x[1:]])


TASK = {"modes": [Mode("rotten", rotten)], "episode_steps": STEPS, "radio": "standard"}


def rolled(env, seed):
    """Rewards, infos of the steps, and the last info of an episode."""
    env.reset(seed=seed)
    _, rewards, *_, infos = zip(*(env.step(0) for _ in range(STEPS)), strict=True)
    return rewards, infos


@pytest.mark.filterwarnings("ignore:an episode ended:RuntimeWarning")
def test_an_episode_counts_the_epochs_after_which_it_had_no_belief():
    env, counts = gym.make(ID, **TASK), []
    for seed in range(6):
        rewards, infos = rolled(env, seed)
        lost = [not np.isfinite(info["nees"]) for info in infos]
        assert infos[-1].get(KEY, 0) == sum(lost)
        assert not any(KEY in info for info in infos[:-1])
        worst = env.unwrapped.reward.worst
        assert all(r == worst for r, gone in zip(rewards, lost, strict=True) if gone)
        counts.append(sum(lost))
    assert min(counts) == 0 and max(counts) > 0  # some are lost


def test_the_episode_says_so():
    env = gym.make(ID, **TASK)
    with pytest.warns(RuntimeWarning, match=KEY):
        rolls = [rolled(env, seed) for seed in range(6)]
    assert len(rolls) == 6


@pytest.mark.filterwarnings("ignore:an episode ended:RuntimeWarning")
@pytest.mark.parametrize("autoreset", ["NextStep", "SameStep", "Disabled"])
def test_the_vector_environment_tells_what_single_ones_tell(autoreset):
    n, single = 6, gym.make(ID, **TASK)
    env = gym.make_vec(ID, num_envs=n, autoreset_mode=autoreset, **TASK)
    env.reset(seed=0)
    for _ in range(STEPS):
        *_, infos = env.step(np.zeros(n, np.int64))
    infos = infos.get("final_info", infos)
    expected = [rolled(single, seed)[1][-1].get(KEY, 0) for seed in range(n)]
    assert infos[KEY].tolist() == expected
    assert infos[f"_{KEY}"].tolist() == [count > 0 for count in expected]


def test_a_vector_environment_warns_also_where_nobody_wants_infos():
    env = gym.make_vec(ID, num_envs=6, infos="none", **TASK)
    env.reset(seed=0)
    with pytest.warns(RuntimeWarning, match=KEY):
        infos = [env.step(np.zeros(6, np.int64))[-1] for _ in range(STEPS)]
    assert infos == [{}] * STEPS


@pytest.mark.slow
def test_a_comparison_leaves_no_such_episode_out_and_says_which_contender_had_some():
    source = SimulatedSource(SCENES["street"], RADIOS["standard"], epochs=STEPS)
    chosen = Contender("mine", tuple(TASK["modes"]), lambda observation: FixedMode(0))
    selection = Selection(range(6))
    with pytest.warns(RuntimeWarning, match=r"^mine: [1-5] of 6 episodes .* NaN or infinite"):
        scores = score_contenders([chosen, "fixed-ekf"], source, "standard", selection)
    lost = np.isnan(scores["mine"]["nees"])
    assert 0 < np.count_nonzero(lost) < 6
    assert (scores["mine"]["divergence_rate"][lost] == 1.0).all()
    comparison = compare_scores(scores, scenario="mixed", radio="standard", selection=selection)
    assert np.isnan(comparison.policies["mine"]["ate_m"].mean)
    row = next(line for line in str(comparison).splitlines() if line.startswith("| mine"))
    assert "nan" in row
    assert np.isfinite(comparison.policies["fixed-ekf"]["ate_m"].mean)
