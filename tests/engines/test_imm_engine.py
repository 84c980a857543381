"""Tests of engines that mix the beliefs of modes: by an IMM alone, or helped by actions."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.contenders import draw_episodes
from mmwave_env.engines.engine import Engine, run_imm
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import Bank, best_bank, default_modes
from mmwave_env.filters.belief import Belief
from mmwave_env.interface.reward import TrackingReward, terms_of, total
from mmwave_env.models.measurement import blank_site
from mmwave_env.models.radio import TUNED_RADIOS
from mmwave_env.numerics.pytree import indices
from mmwave_env.world.episode import EpisodeBatch
from tests.filters.gated_textbook import textbook_imm
from tests.filters.tracks import (
    assert_same_beliefs,
    packed,
    pipeline_of,
    process_noise,
    simulated,
    street_source,
    track,
    unpacked,
)
from tests.refusals import refuses

N = 11
T = 60
MODES = default_modes()
every_radio = pytest.mark.parametrize("radio", TUNED_RADIOS)


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


@pytest.mark.parametrize("on_floats", [False, True], ids=["SIMD", "plain Python"])
def test_epochs_after_the_end_of_an_episode_are_blank(on_floats):
    def engine_of(episodes):
        pipeline = pipeline_of(episodes[0].layout, ("ekf",))
        engine = Engine(pipeline, len(episodes), TrackingReward(), on_floats=on_floats)
        engine.load(episodes)
        engine.step()
        return engine

    long = simulated(1, epochs=12)[0]
    short = simulated(1, epochs=3)[0]
    together = engine_of([long, short])
    alone = engine_of([short])
    for _ in range(5):
        together.step(np.int64(0))
        alone.step(np.int64(0))
        assert_array_equal(together.column(1), alone.column(0))
    assert alone.read(alone.at.pending.visible).max() == 0.0


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
@every_radio
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


# --- an action raises the odds of a mode, or of none
PLAIN = {"gate": None, "adaptive": False, "coupling": False}
BANK = Bank(
    (Mode("slow", "ekf", sigma_v=0.3, **PLAIN), Mode("fast", "ukf", sigma_v=1.8, **PLAIN)),
    ((0.9, 0.1), (0.3, 0.7)),
    0.99,
)


def in_steps_of(dt, episodes):
    return [replace(episode, time_s=dt * np.arange(len(episode))) for episode in episodes]


def played(bank, episodes, actions, *names):
    """Return parts (n, T, ...) of an engine's workspace after each of the actions (n, T)."""
    pipeline = Pipeline(bank.modes, episodes[0].layout)
    parts = track(pipeline, episodes, actions.T, actions.shape[1], names, bank=bank)
    return {name: values.swapaxes(0, 1) for name, values in parts.items()}


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1.0, 0.1])
@every_radio
def test_trusting_no_mode_equals_the_imm(radio, dt):
    bank = best_bank(radio)
    episodes = in_steps_of(dt, simulated(9, epochs=200))
    ours = played(bank, episodes, np.zeros((9, 200), int), "x", "P", "reward", "nees")
    expected = run_imm(bank, TrackingReward(), episodes, *ours)
    for name, values in ours.items():
        assert_allclose(values, expected[name], rtol=1e-10, atol=1e-10, err_msg=name)


@pytest.mark.parametrize(("dt", "nis_quantile", "off_m"), [(1.0, 1.0, 90.0), (0.25, 0.99, 0.0)])
def test_a_mixture_and_trust_in_its_modes_equal_the_textbook(dt, nis_quantile, off_m):
    """Compare with a textbook IMM in which each epoch raises the trusted mode's probability.

    If a range is 90 m off, all likelihoods would underflow without logarithms.
    """
    episodes = in_steps_of(dt, simulated(4, epochs=30))
    episodes[0].measurement[10, 4] += off_m
    actions = np.random.default_rng(1).integers(0, 3, (4, 30))
    bank = replace(BANK, nis_quantile=nis_quantile)
    ours = played(bank, episodes, actions, "x", "P", "mode_probabilities", "memory.mode")
    for e, episode in enumerate(episodes):
        modes = [
            (mode.algorithm, process_noise(mode, hz_per_mps=episode.hz_per_mps))
            for mode in BANK.modes
        ]

        def change(t, probability, chosen=actions[e]):
            step = dt if t else 1.0
            factor = np.ones(2)
            if chosen[t]:
                factor[chosen[t] - 1] = np.exp(3.0 * step)
            return factor * probability / (factor @ probability)

        step = [1.0, *[dt] * 29]
        T_ij = np.array(BANK.transition)
        transitions = [np.eye(2) + s * (T_ij - np.eye(2)) for s in step]
        x, P, probability = textbook_imm(episode, modes, transitions, nis_quantile, change)
        mixture = {name: ours[name][e] for name in ("x", "P")}
        assert_same_beliefs(mixture, {"x": x, "P": packed(P)}, rtol=1e-8)
        assert_allclose(ours["mode_probabilities"][e], probability, rtol=1e-7, atol=1e-9)
        assert_array_equal(ours["memory.mode"][e], probability.argmax(axis=1))
