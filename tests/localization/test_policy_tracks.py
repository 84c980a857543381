"""Tests that tracks of logs equal the engine's tracks if a policy chooses modes; of live rows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import Engine
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.correction import corrected
from mmwave_env.interface.policy import Switching
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.localization.localizer import episode_from, localize
from mmwave_env.localization.starts import start_at
from mmwave_env.localization.tracker import Tracker
from mmwave_env.logs.log import read_log
from mmwave_env.numerics.linalg import unpack
from policies import Corrector, LearnedSwitch, load
from tests.localization.test_live_epochs import RADIO, SCENE, WALK, walk
from tests.logs.by_hand import refuses_log
from tests.paths import representative
from tests.policies.test_corrector import card, network
from tests.training.actors import write

EPOCHS = 60
ROWS = walk(EPOCHS)  # for each epoch, its rows of the log as dicts by column


def first_epochs():
    """Return the first epochs of the walk."""
    return read_log(WALK / "log.csv", SCENE).part(slice(EPOCHS))


def whole_track(switching, window=None):
    """Return the track of the walk's first epochs."""
    return localize(first_epochs(), SCENE, RADIO, switching, window=window)


def environment(switching, observation):
    """Return an engine that has filtered the first of the walk's first epochs."""
    whole = first_epochs()
    pipeline = switching.pipeline(whole.layout, planar=False)
    engine = Engine(pipeline, 1, TrackingReward(), observation, switching.bank)
    engine.load([episode_from(whole, SCENE, RADIO, start_at(whole, 0, SCENE, RADIO))])
    engine.step()
    return engine


@pytest.mark.parametrize("name", representative(("guided", "ppo-standard"), "ppo-standard"))
@pytest.mark.parametrize("chunk", [7, EPOCHS])
def test_the_track_equals_the_track_in_the_environment_to_the_last_bit(monkeypatch, name, chunk):
    monkeypatch.setattr("mmwave_env.localization.localizer._CHUNK", chunk)
    switching = load(name, "standard")
    engine = environment(switching, switching.observation)
    policy = LearnedSwitch(name, engine.observation)
    expected = []
    for _ in range(EPOCHS):
        engine.step(policy.act(engine.observations()))
        expected.append(engine.read(engine.at.x)[0])
    track = whole_track(switching)
    assert_array_equal(track.x, expected)


# --- correctors: policies that correct beliefs


@pytest.fixture(scope="module")
def corrector(tmp_path_factory):
    """Return the policy file of a corrector with random weights."""
    path = tmp_path_factory.mktemp("corrector") / "mine.safetensors"
    return write(path, network(limit=50.0), card())


@pytest.mark.slow  # compiles large programs
def test_a_corrected_track_has_the_corrected_beliefs_of_the_environment(corrector):
    switching = load(corrector, "standard")
    engine = environment(switching, "signed")
    policy = Corrector(corrector, engine.observation)
    expected = []
    trusted = []
    policy.reset(np.ones(1, bool))
    for _ in range(EPOCHS):
        observation = engine.step(policy.act(engine.observations()))
        correction = policy.correct(observation)
        P = unpack(engine.read(engine.at.P)[0].tolist())
        belief = Belief(engine.read(engine.at.x)[0].tolist(), P)
        expected.append(
            corrected(belief, correction.shift[0].tolist(), correction.log_factor[0].tolist()).x
        )
        trusted.append(correction.trusted[0])
    track = whole_track(switching)
    assert_allclose(track.x, expected, atol=1e-6)
    assert_allclose(track.trusted, trusted, atol=1e-6)
    assert (track.trusted > 0.1).mean() > 0.5


@pytest.mark.slow  # compiles large programs
def test_a_track_is_smoothed_from_beliefs_without_corrections(corrector):
    switching = load(corrector, "standard")
    bank = Switching(switching.bank)
    smooth = whole_track(switching, window=50).smooth_x
    expected = whole_track(bank, window=50).smooth_x
    assert_allclose(smooth, expected, atol=1e-9)


WRONG = [("aoa_azimuth_rad", "north"), ("anchor", 9), ("toa_s", "1e"), ("time_s", -1.0)]
WRONG.append(("time_s", ROWS[3][0]["time_s"] + 1e-9))  # a step that is too short


@pytest.mark.parametrize(("field", "wrong"), WRONG)
def test_an_error_names_the_field_of_a_damaged_row_and_the_epoch_can_be_sent_again(field, wrong):
    switching = Switching(LearnedSwitch("ppo-standard").modes[:1])
    tracker, undisturbed = (Tracker(SCENE, switching, "standard") for _ in range(2))
    for epoch in ROWS[:3]:
        tracker.update(epoch)
        undisturbed.update(epoch)
    first, second, *_ = ROWS[3]
    with refuses_log(field):
        tracker.update([first, second | {field: wrong}])
    assert tracker.update(ROWS[3]) == undisturbed.update(ROWS[3])
