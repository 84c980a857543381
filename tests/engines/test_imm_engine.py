"""Tests of the engine that runs an IMM over complete episodes."""

from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.contenders import draw_episodes
from mmwave_env.engines.engine import run_imm
from mmwave_env.filters.bank import Bank, best_bank, default_modes
from mmwave_env.filters.belief import Belief
from mmwave_env.interface.reward import TrackingReward, terms_of, total
from mmwave_env.models.measurement import blank_site
from mmwave_env.models.radio import TUNED_RADIOS
from mmwave_env.numerics.pytree import indices
from mmwave_env.world.episode import EpisodeBatch
from tests.filters.tracks import simulated, street_source, unpacked
from tests.refusals import refuses

N = 11
T = 60
MODES = default_modes()


@pytest.fixture(scope="module")
def episodes():
    return simulated(N, epochs=T)


def test_rewards_errors_and_nees_follow_from_the_belief(episodes):
    reward = TrackingReward()
    names = ("x", "P", "reward", "error", "nees")
    parts = run_imm(Bank(MODES), reward, episodes, *names)
    for e, t in ((0, 0), (3, 7), (N - 1, T - 1)):
        x, P, earned, error, nees = (parts[name][e, t] for name in names)
        truth = episodes[e].truth_position_m[t]
        P = unpacked(P)
        assert_allclose(error, x[:3] - truth, atol=1e-12)
        assert_allclose(nees, error @ np.linalg.solve(P[:3, :3], error))
        belief = Belief(x.tolist(), P.tolist())
        paid = total(terms_of(reward(belief, [*truth, 0.0, 0.0, 0.0])))
        assert earned == pytest.approx(paid)


def test_an_episode_gives_the_same_results_alone_as_in_a_batch(episodes):
    imm = partial(run_imm, Bank(MODES), TrackingReward())
    lengths = [T, 25, 1, T - 1]
    packed = EpisodeBatch.of(episodes[:4])
    cut = packed._replace(length=np.array(lengths))
    together = imm(cut, "x", "nees")
    for e, length in enumerate(lengths):
        alone = imm([episodes[e]], "x", "nees")
        for name, values in alone.items():
            assert_array_equal(together[name][e, :length], values[0, :length])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("transition", [[0.9, 0.1]]),
        ("transition", [[0.9, 0.2], [0.1, 0.9]]),
        ("transition", [[1.1, -0.1], [0.1, 0.9]]),
        ("transition", [[1.0, 0.0], [1.0, 0.0]]),
        ("transition", [[np.nan, 1.0], [0.1, 0.9]]),
        ("nis_quantile", 0.0),
        ("nis_quantile", 1.5),
        ("nis_quantile", np.nan),
    ],
)
def test_an_invalid_transition_or_quantile_is_refused(name, value):
    with refuses(name):
        Bank(MODES, **{name: value})


@pytest.mark.slow
@pytest.mark.parametrize("radio", TUNED_RADIOS)
def test_a_track_that_starts_100_m_off_recovers(radio):
    seeds = range(5_000_000, 5_000_040)
    batch = EpisodeBatch.of(draw_episodes(street_source(radio=radio), seeds))
    site = batch.site.copy()
    prior = indices(blank_site(batch.layout)).prior_x
    direction = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, len(site))
    site[:, prior[0]] += 100.0 * np.cos(direction)
    site[:, prior[1]] += 100.0 * np.sin(direction)
    imm = partial(run_imm, best_bank(radio), TrackingReward())
    good = np.linalg.norm(imm(batch, "error")["error"], axis=2)
    bad = np.linalg.norm(imm(batch._replace(site=site), "error")["error"], axis=2)
    assert (bad[:, 0] > 50.0).mean() > 0.5
    assert (bad[:, -1] < good[:, -1] + 5.0).all()
