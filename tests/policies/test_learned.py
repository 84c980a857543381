"""Tests of learned policies: networks, banks of modes, and features, which are found by name."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.env import MmWaveLocEnv
from mmwave_env.filters import Pipeline
from mmwave_env.interface.observation import Observation
from mmwave_env.models.layout import Layout
from policies import LearnedSwitch, load, shipped_policies
from tests.cli import printed
from tests.filters.tracks import replay, simulated
from tests.refusals import refuses
from tests.training.actors import (
    FEATURES,
    HANDSET,
    MODES,
    PER_MODE_TABLE,
    PIPELINE,
    STANDARD,
    TABLE,
    actor,
    card_of,
    write,
    write_per_mode,
)


@pytest.fixture
def shared(tmp_path):
    """Return the file of a policy whose modes share one belief."""
    return write(tmp_path / "shared.safetensors", actor(), card_of())


@pytest.fixture
def per_mode(tmp_path):
    """Return the file of a policy with one belief per mode and banks for two radios."""
    return write_per_mode(tmp_path / "trust.safetensors")


def exact_logits(tensors, observations):
    """Return logits (episodes, steps, modes), computed in double precision."""
    exact = {name: tensor.astype(float) for name, tensor in tensors.items()}
    x = np.clip(observations, exact["low"], exact["high"])
    layers = sum(name.endswith(".weight") for name in exact)
    for i in range(layers):
        x = x @ exact[f"layer.{i}.weight"].T + exact[f"layer.{i}.bias"]
        if i < layers - 1:
            x = np.tanh(x)
    return x


@pytest.mark.parametrize("hidden", [(5, 4), ()])
def test_logits_equal_a_computation_in_double_precision(tmp_path, hidden):
    """Check observations inside and outside the limits to which a policy clips observations."""
    tensors = actor(hidden=hidden)
    policy = LearnedSwitch(write(tmp_path / "mine.safetensors", tensors, card_of()))
    rng = np.random.default_rng(1)
    episodes = rng.normal(0.0, 1.5, (20, 15, FEATURES)).astype(np.float32)
    policy.reset(np.ones(20, bool))
    logits = np.stack([policy.logits(now) for now in episodes.swapaxes(0, 1)], axis=1)
    assert_allclose(logits, exact_logits(tensors, episodes), atol=1e-4)


@pytest.mark.parametrize("shape", [(FEATURES,), (2, FEATURES - 1), (1, 2, FEATURES)])
def test_observations_of_another_shape_are_refused(shared, shape):
    with refuses("observation"):
        LearnedSwitch(shared).act(np.zeros(shape, np.float32))


RENAMED = tuple(replace(mode, name=f"my {mode.name}") for mode in MODES)
RETUNED = (replace(MODES[0], sigma_v=9.0), *MODES[1:])


@pytest.mark.parametrize("modes", [MODES[:2], MODES[::-1], RENAMED, RETUNED])
def test_an_environment_with_other_modes_is_refused(shared, modes):
    with refuses(shared):
        LearnedSwitch(shared, Observation(Pipeline(modes, Layout())))


def test_a_radio_without_its_own_bank_gets_the_bank_of_the_standard_radio(per_mode, tmp_path):
    policy = LearnedSwitch(per_mode)
    assert policy.modes == MODES and policy.beliefs == "per-mode"
    assert policy.bank() == policy.bank("handset") == HANDSET
    assert policy.bank("standard") == policy.bank("high") == STANDARD
    (tmp_path / "radio.json").write_text('{"name": "lab", "base": "handset"}')
    banks = {"handset": HANDSET, "lab": STANDARD}
    mine = LearnedSwitch(write_per_mode(tmp_path / "mine.safetensors", banks=banks))
    assert mine.bank(str(tmp_path / "radio.json")) == STANDARD  # by the radio's name, not its base
    assert mine.bank("standard") == HANDSET  # no bank fits, so the first bank is used


def test_a_policy_accepts_the_modes_of_each_of_its_banks_and_no_other_modes(per_mode):
    policy = LearnedSwitch(per_mode)
    for bank in (HANDSET, STANDARD):
        policy.read_from(Observation(Pipeline(bank.modes, Layout()), "full", "per-mode"))
    for table in (TABLE, Observation(Pipeline(RETUNED, Layout()), "full", "per-mode")):
        with refuses(per_mode, "per-mode"):
            policy.read_from(table)


def test_a_policy_for_a_shared_belief_has_no_bank_and_accepts_no_beliefs_per_mode(shared):
    policy = LearnedSwitch(shared)
    assert policy.beliefs == "shared"
    with refuses(shared):
        policy.bank("handset")
    with refuses(shared, "shared"):
        policy.read_from(PER_MODE_TABLE)


def test_a_policy_finds_its_features_among_other_features(shared):
    more = Observation(Pipeline(MODES, Layout(5, odometry=True)))
    columns = [more.names.index(name) for name in TABLE.names]
    observed = np.random.default_rng(3).normal(size=(50, len(more))).astype(np.float32)
    policy = LearnedSwitch(shared, more)
    same = LearnedSwitch(shared, TABLE)
    assert len(more) > len(TABLE)
    expected = same.logits(np.ascontiguousarray(observed[:, columns]))
    assert_array_equal(policy.logits(observed), expected)


def test_an_anchor_that_a_scene_lacks_counts_as_never_visible(per_mode):
    (episode,) = simulated(1, 30)
    episode = replace(episode, visible=episode.visible & [True, True, False, True])
    env = MmWaveLocEnv(episodes=replay(episode), beliefs="per-mode", modes=HANDSET)
    env.reset(seed=0)
    observed = np.array([env.step(0)[0] for _ in range(28)])
    two = Observation(Pipeline(MODES, Layout(2)), "full", "per-mode")
    columns = [PER_MODE_TABLE.columns.index(column) for column in two.columns]
    expected = LearnedSwitch(per_mode, PER_MODE_TABLE).logits(observed)
    actual = LearnedSwitch(per_mode, two).logits(observed[:, columns])
    assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


def test_the_error_names_a_feature_that_is_missing_or_has_another_scale(shared, per_mode):
    with refuses("feature 'coming Doppler innovation'"):
        LearnedSwitch(shared, Observation(PIPELINE, "prior"))
    with refuses("feature 'distance anchor 3'"):  # no distance can stand for a missing anchor
        LearnedSwitch(shared, Observation(Pipeline(MODES, Layout(anchors=2))))
    with refuses("feature 'coming Doppler innovation'"):
        LearnedSwitch(per_mode, Observation(Pipeline(MODES, Layout(2)), "prior", "per-mode"))
    column = TABLE.columns[4]
    for change in ({"unit": "ft"}, {"mean": column.mean + 1.0}, {"deviation": 7.0}):
        features = (*TABLE.columns[:4], column._replace(**change), *TABLE.columns[5:])
        write(shared, actor(), card_of(features=features))
        with refuses(f"feature '{column.name}'"):
            LearnedSwitch(shared, TABLE)


def test_every_shipped_policy_works_with_this_version():
    for path in shipped_policies().values():
        policy = load(path).start(Layout())
        assert load(path.stem).start(Layout()).card == policy.card
    with refuses("policy"):
        load("ppo")  # the name lacks a radio


def test_a_policy_runs_without_torch_and_pickle(shared):
    code = (
        "import sys, numpy as np, pickle; from policies import LearnedSwitch\n"
        "def refuse(*_): raise AssertionError('unpickled')\n"
        "pickle.load = pickle.loads = pickle.Unpickler = refuse\n"
        f"policy = LearnedSwitch({str(shared)!r})\n"
        "policy.reset(np.ones(2, bool))\n"
        f"print(policy.act(np.zeros((2, {FEATURES}), np.float32)).shape)\n"
        "assert not {'torch', 'stable_baselines3'} & set(sys.modules)\n"
    )
    assert printed(code) == "(2,)\n"
