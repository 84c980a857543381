"""Tests that an epoch's verbs give the same numbers, whichever of them run together."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import Engine
from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import corrected
from mmwave_env.interface.actions import CORRECTION
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.interface.signed import after_update
from mmwave_env.numerics.linalg import pack, unpack
from mmwave_env.task import task_from

BANK = Bank((Mode("stand", sigma_v=0.1), Mode("ride", sigma_v=1.5)))
N = 2
T = 6
ACTIONS = np.random.default_rng(0).integers(3, size=(T, N))
NUMBERS = np.random.default_rng(1).uniform(-1.0, 1.0, (T, N, 6))
BELIEF = ("x", "P", "reward")
REPORTED = ("reported.x", "reported.P", "reward", "reported.reward")


@pytest.fixture(scope="module")
def episodes():
    """Return N episodes; in the last one, the Doppler spread is not measured."""
    source = task_from(beliefs="per-mode", modes=BANK, episode_steps=T).simulated
    *others, last = source.episodes(np.arange(N, dtype=np.uint64))
    return [*others, replace(last, doppler_spread_hz=np.zeros(T))]


def engine_of(episodes, **arguments):
    """Return an engine with these episodes in plain Python, which needs no time to compile."""
    pipeline = Pipeline(BANK.modes, episodes[0].layout)
    engine = Engine(pipeline, N, TrackingReward(), "signed", BANK, on_floats=True, **arguments)
    engine.load(episodes)
    return engine


def after(engine):
    """Return the columns of observations that describe the belief after its update."""
    features = after_update(engine.pipeline)
    return [engine.observation.names.index(feature.name) for feature in features]


def test_filter_and_decide_are_an_environments_step_in_two_parts(episodes):
    stepped = engine_of(episodes)
    stepped.step()
    engine = engine_of(episodes, action=CORRECTION)
    rows = engine.program.rows(BELIEF)
    columns = after(engine)
    for actions in ACTIONS:
        assert_array_equal(engine.filter(), stepped.observations())
        observations, outputs = engine.decide(actions, rows, scored=True)
        coming = stepped.step(actions)
        assert_array_equal(observations[:, columns], coming[:, columns])
        expected = [stepped.column(i)[stepped.program.rows(BELIEF)] for i in range(N)]
        assert_allclose(outputs, expected, rtol=1e-12)


def test_a_correction_changes_the_reported_belief_and_not_the_filters(episodes):
    engine = engine_of(episodes, action=CORRECTION)
    for actions, numbers in zip(ACTIONS, NUMBERS, strict=True):
        engine.filter()
        _, decided = engine.decide(actions, engine.program.rows(BELIEF), scored=True)
        outputs = engine.correct(numbers, engine.program.rows(REPORTED))
        assert_array_equal(engine.read(engine.at.x), decided[:, :7])
        assert_array_equal(outputs[:, -1], decided[:, -1])
        for before, number, output in zip(decided.tolist(), numbers.tolist(), outputs, strict=True):
            expected = corrected(Belief(before[:7], unpack(before[7:35])), number[:3], number[3:])
            assert_allclose(output[:7], expected.x, rtol=1e-12)
            assert_allclose(output[7:35], pack(expected.P), rtol=1e-12)


def test_corrections_in_an_environment_are_those_of_a_track_with_the_same_choices(episodes):
    choices = iter([*ACTIONS, np.zeros(N, np.int64)])
    environment = engine_of(
        episodes, action=CORRECTION, base=lambda table: lambda observed: next(choices)
    )
    environment.show(after_update(environment.pipeline))
    environment.load(episodes)
    environment.step()
    track = engine_of(episodes, action=CORRECTION)
    rows = track.program.rows(REPORTED)
    for actions, numbers in zip(ACTIONS, NUMBERS, strict=True):
        track.filter()
        observations, _ = track.decide(actions)
        assert_array_equal(environment.observations(), observations[:, after(track)])
        io = environment.io(rows)
        io.inputs[:, 0, 1:] = numbers
        environment.advance(io)
        environment.trust(io)
        assert_allclose(io.outputs[:, 0], track.correct(numbers, rows), rtol=1e-12)
