"""Tests of the clairvoyant, a policy that knows the truth and tries every action in advance."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from experiments.evaluation import branches
from experiments.evaluation.contenders import contender_from
from experiments.evaluation.runner import run_contender, score
from mmwave_env.engines.engine import Engine
from mmwave_env.filters import Pipeline
from mmwave_env.interface.reward import TrackingReward
from tests.filters.tracks import street_source
from tests.refusals import refuses
from tests.training.actors import HANDSET

# engines compute blocks of 8 environments; these 5 do not fill a block
N = 5
EPOCHS = 30
EPISODES = street_source(epochs=EPOCHS).episodes(np.arange(N, dtype=np.uint64))
LAYOUT = EPISODES[0].layout


def begun(done):
    """Return an engine with beliefs per mode after ``done`` epochs of action 0 (favor no mode)."""
    engine = Engine(Pipeline(HANDSET.modes, LAYOUT), N, TrackingReward(), "full", HANDSET)
    engine.load(EPISODES)
    engine.step()
    for _ in range(done):
        engine.step(np.int64(0))
    return engine


def earned(engine, action):
    """Take an action; return the rewards (N,)."""
    engine.step(action)
    return engine.read(engine.at.reward)


def rest(done, action):
    """Return total rewards (N,) after ``done`` epochs if ``action`` is taken, and later only 0."""
    engine = begun(done)
    total = 0.0
    for taken in [action, *[np.int64(0)] * (EPOCHS - done - 1)]:
        total += earned(engine, taken)
    return total


@pytest.mark.parametrize("done", [0, 25])
def test_a_clairvoyant_with_a_long_enough_horizon_takes_the_best_action(done, monkeypatch):
    monkeypatch.setattr(branches, "HORIZON_S", 1000.0)
    policy = branches.Clairvoyant()
    engine = begun(0)
    policy.foresee(engine)
    for _ in range(done):
        engine.step(np.int64(0))
    best = rest(done, policy.act(engine.observations()))
    every = [rest(done, np.int64(action)) for action in range(len(HANDSET.modes) + 1)]
    assert_allclose(best, np.max(every, axis=0), rtol=1e-9)
    assert (best > every[0]).any()


def test_the_clairvoyant_earns_more_than_the_imm_and_leaves_episodes_unchanged():
    policy = contender_from("clairvoyant", "handset", HANDSET)
    imm = contender_from("imm", "handset", HANDSET)
    knows = score(policy, EPISODES)["reward"]
    mixes = score(imm, EPISODES)["reward"]
    assert knows.mean() > mixes.mean()
    actions = run_contender(policy, EPISODES)["mode"]
    engine = begun(0)
    rewards = [earned(engine, now) for now in actions.T]
    assert_allclose(np.mean(rewards[10:], axis=0), knows, rtol=1e-9)


def test_the_clairvoyant_is_refused_for_episodes_without_truth():
    policy = contender_from("clairvoyant", "handset", HANDSET)
    unknown = [replace(e, truth_position_m=None, truth_velocity_mps=None) for e in EPISODES]
    with refuses("policy"):
        run_contender(policy, unknown)
    with refuses("policy"):  # nothing called foresee, as when a log is localized
        policy.start(LAYOUT).act(begun(0).observations())
