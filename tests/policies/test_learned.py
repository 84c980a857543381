"""Tests of learned policies: their networks and banks, and how they find features by name."""

from dataclasses import replace

import numpy as np
import pytest

from mmwave_env.env import MmWaveLocEnv
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import Observation
from mmwave_env.models.layout import Layout
from policies import LearnedSwitch, learned_policy, shipped_policies
from tests.cli import python
from tests.filters.tracks import replay, simulated
from tests.refusals import refuses
from tests.training.actors import (
    FEATURES,
    HANDSET,
    MODES,
    PER_MODE_TABLE,
    STANDARD,
    TABLE,
    actor,
    card_of,
    write,
    write_per_mode,
)

KINDS = {"plain": {}, "linear": {"hidden": ()}, "narrow": {"hidden": (7,)}}


@pytest.fixture
def make(tmp_path):
    """Return a function that returns a policy of one of the KINDS, and its network's tensors."""

    def policy_and_tensors(kind, **changes):
        tensors = actor(**KINDS[kind] | changes)
        return LearnedSwitch(write(tmp_path / f"{kind}.safetensors", tensors, card_of())), tensors

    return policy_and_tensors


def observations(*shape, seed=1):
    """Return random observations, many of them outside the limits to which policies clip."""
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 1.5, (*shape, FEATURES)).astype(np.float32)


def logits_by_hand(tensors, observations):
    """Return logits (episodes, steps, modes), computed in double precision."""
    exact = {name: tensor.astype(float) for name, tensor in tensors.items()}
    x = np.clip(observations, exact["low"], exact["high"])
    layers = sum(name.endswith(".weight") for name in exact)
    for i in range(layers):
        x = x @ exact[f"layer.{i}.weight"].T + exact[f"layer.{i}.bias"]
        if i < layers - 1:
            x = np.tanh(x)
    return x


@pytest.mark.parametrize("kind", KINDS)
def test_logits_equal_those_in_double_precision(make, kind):
    policy, tensors = make(kind)
    episodes = observations(20, 15)
    policy.reset(np.ones(20, bool))
    logits = np.stack([policy.logits(now) for now in episodes.swapaxes(0, 1)], axis=1)
    np.testing.assert_allclose(logits, logits_by_hand(tensors, episodes), atol=1e-4)


@pytest.mark.parametrize("shape", [(FEATURES,), (2, FEATURES - 1), (1, 2, FEATURES)])
def test_observations_of_another_shape_are_refused(make, shape):
    policy, _ = make("plain")
    with refuses("observation"):
        policy(np.zeros(shape, np.float32))


RENAMED = tuple(replace(mode, name=f"my {mode.name}") for mode in MODES)
RETUNED = (replace(MODES[0], sigma_v=9.0), *MODES[1:])


@pytest.mark.parametrize("modes", [MODES[:2], MODES[::-1], RENAMED, RETUNED])
def test_an_environment_with_other_modes_is_refused(make, tmp_path, modes):
    policy, _ = make("plain")
    policy.read_from(TABLE)
    other = Observation(Pipeline(modes, Layout()))
    with refuses("plain.safetensors"):
        policy.read_from(other)
    with refuses("plain.safetensors"):
        LearnedSwitch(tmp_path / "plain.safetensors", other)


@pytest.fixture
def per_mode(tmp_path):
    """Return a policy with one belief per mode and banks for two radios."""
    return LearnedSwitch(write_per_mode(tmp_path / "trust.safetensors"))


def test_a_radio_gets_the_bank_trained_for_it_and_other_radios_the_bank_of_standard(
    per_mode, tmp_path
):
    assert per_mode.modes == MODES and per_mode.beliefs == "per-mode"
    assert per_mode.bank() == per_mode.bank("handset") == HANDSET
    assert per_mode.bank("standard") == per_mode.bank("high") == STANDARD
    (tmp_path / "radio.json").write_text('{"name": "lab", "base": "handset"}')
    banks = {"handset": HANDSET, "lab": STANDARD}
    mine = LearnedSwitch(write_per_mode(tmp_path / "mine.safetensors", banks=banks))
    assert mine.bank(str(tmp_path / "radio.json")) == STANDARD  # by the radio's name, not its base
    assert mine.bank("standard") == HANDSET  # no bank fits, so the first one is used


def test_a_policy_accepts_the_modes_of_each_of_its_banks_and_no_others(per_mode):
    for bank in (HANDSET, STANDARD):
        per_mode.read_from(Observation(Pipeline(bank.modes, Layout()), "full", "per-mode"))
    for table in (TABLE, Observation(Pipeline(RETUNED, Layout()), "full", "per-mode")):
        with refuses("trust.safetensors", "per-mode"):
            per_mode.read_from(table)


def test_a_policy_over_a_shared_belief_has_no_bank_and_accepts_no_other_beliefs(make):
    shared, _ = make("plain")
    assert shared.beliefs == "shared"
    with refuses("plain.safetensors"):
        shared.bank("handset")
    with refuses("plain.safetensors", "shared"):
        shared.read_from(PER_MODE_TABLE)


@pytest.mark.parametrize("table", [TABLE, PER_MODE_TABLE])
def test_a_policy_finds_its_features_among_others(tmp_path, table):
    path = write_per_mode(tmp_path / "mine.safetensors")
    if table is TABLE:
        path = write(path, actor(), card_of())
    more = Observation(Pipeline(MODES, Layout(5, odometry=True)), "full", table.beliefs)
    columns = [more.names.index(name) for name in table.names]
    observed = np.random.default_rng(3).normal(size=(50, len(more))).astype(np.float32)
    policy, same = LearnedSwitch(path, more), LearnedSwitch(path, table)
    assert len(more) > len(table)
    expected = same.logits(np.ascontiguousarray(observed[:, columns]))
    np.testing.assert_array_equal(policy.logits(observed), expected)


def test_an_anchor_that_a_scene_lacks_counts_as_never_visible(tmp_path):
    path = write_per_mode(tmp_path / "mine.safetensors")
    (episode,) = simulated(1, 30)
    episode = replace(episode, visible=episode.visible & [True, True, False, True])
    env = MmWaveLocEnv(episodes=replay(episode), beliefs="per-mode", modes=HANDSET)
    env.reset(seed=0)
    observed = np.array([env.step(0)[0] for _ in range(28)])
    two = Observation(Pipeline(MODES, Layout(2)), "full", "per-mode")
    columns = [PER_MODE_TABLE.columns.index(column) for column in two.columns]
    expected = LearnedSwitch(path, PER_MODE_TABLE).logits(observed)
    actual = LearnedSwitch(path, two).logits(observed[:, columns])
    np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-5)


def test_a_feature_that_is_missing_or_has_another_scale_is_refused_by_name(tmp_path):
    path = write(tmp_path / "mine.safetensors", actor(), card_of())
    with refuses("feature 'coming Doppler innovation'"):
        LearnedSwitch(path, Observation(Pipeline(MODES, Layout()), "prior"))
    with refuses("feature 'distance anchor 3'"):  # no value can stand for a missing anchor
        LearnedSwitch(path, Observation(Pipeline(MODES, Layout(anchors=2))))
    per_mode = write_per_mode(tmp_path / "trust.safetensors")
    with refuses("feature 'coming Doppler innovation'"):
        LearnedSwitch(per_mode, Observation(Pipeline(MODES, Layout(2)), "prior", "per-mode"))
    column = TABLE.columns[4]
    for change in ({"unit": "ft"}, {"mean": column.mean + 1.0}, {"deviation": 7.0}):
        features = (*TABLE.columns[:4], column._replace(**change), *TABLE.columns[5:])
        write(path, actor(), card_of(features=features))
        with refuses(f"feature '{column.name}'"):
            LearnedSwitch(path, TABLE)


def test_every_shipped_policy_works_with_this_version():
    for path in shipped_policies().values():
        policy = learned_policy(path)
        pipeline = Pipeline(policy.modes, Layout())
        policy.read_from(Observation(pipeline, policy.card.observation, policy.beliefs))
        assert learned_policy(path.stem).card == policy.card
    with refuses("policy"):
        learned_policy("ppo")  # the name lacks a radio


def test_a_policy_runs_without_torch_and_pickle(make, tmp_path):
    make("narrow")
    code = (
        "import sys, numpy as np, pickle; from policies import LearnedSwitch\n"
        "def refuse(*_): raise AssertionError('unpickled')\n"
        "pickle.load = pickle.loads = pickle.Unpickler = refuse\n"
        f"policy = LearnedSwitch({str(tmp_path / 'narrow.safetensors')!r})\n"
        "policy.reset(np.ones(2, bool))\n"
        f"print(policy(np.zeros((2, {FEATURES}), np.float32)).shape)\n"
        "assert not {'torch', 'stable_baselines3'} & set(sys.modules)\n"
    )
    done = python(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(2,)"
