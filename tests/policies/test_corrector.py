"""Tests of correctors, which correct beliefs: network, memory, fading of corrections, and files."""

import pickle
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.engines.engine import Engine, play
from mmwave_env.filters import Pipeline
from mmwave_env.filters.correction import MOST_LOG_FACTOR, MOST_SHIFT
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import policy_from
from mmwave_env.interface.signed import after_update
from mmwave_env.models.layout import Layout
from mmwave_env.task import task_from
from policies import Corrector, LearnedSwitch, load
from policies.corrector import TwoWayCorrector
from policies.policy_file import CORRECTIONS
from tests.refusals import refuses
from tests.training.actors import (
    MODES,
    PER_MODE,
    PER_MODE_TABLE,
    PIPELINE,
    card_of,
    write,
    write_per_mode,
)

TABLE = Observation(PIPELINE, "signed", "per-mode")
NAMES = [feature.name for feature in after_update(PIPELINE)]
COLUMNS = tuple(column for column in TABLE.columns if column.name in NAMES)
# sizes of the network's layers
FEATURES = len(NAMES)
FRONT = 6
UNITS = 5
HEAD = 4
MEMBERS = 3  # output layers, whose corrections are averaged


# names of recurrent units
ONE_WAY = ("gru",)
TWO_WAY = ("gru", "back")


def network(scale=0.3, limit=5.0, units=ONE_WAY):
    """Return a corrector's tensors: random weights, and the limits ±``limit`` of all features."""
    rng = np.random.default_rng(0)
    of_unit = {
        "weight_ih": (3 * UNITS, FRONT), "weight_hh": (3 * UNITS, UNITS),
        "bias_ih": (3 * UNITS,), "bias_hh": (3 * UNITS,),
    }  # fmt: skip
    shapes = {f"{unit}.{name}": shape for unit in units for name, shape in of_unit.items()} | {
        "front.weight": (FRONT, FEATURES), "front.bias": (FRONT,),
        "head.weight": (HEAD, len(units) * UNITS + FRONT), "head.bias": (HEAD,),
        "out.weight": (MEMBERS * CORRECTIONS, HEAD), "out.bias": (MEMBERS * CORRECTIONS,),
    }  # fmt: skip
    tensors = {
        name: rng.normal(0.0, scale, shape).astype(np.float32) for name, shape in shapes.items()
    }
    limits = np.full(FEATURES, limit, np.float32)
    return tensors | {"low": -limits, "high": limits}


def card(**changes):
    return card_of(TABLE, features=COLUMNS, base="imm-best", **PER_MODE | changes)


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "corrector.safetensors", network(), card())


@pytest.fixture
def two_way_path(tmp_path):
    return write(tmp_path / "two-way.safetensors", network(units=TWO_WAY), card())


def started(path, table=None):
    """Return a corrector of four environments at the beginning of their episodes."""
    corrector = Corrector(path, table) if table else Corrector(path)
    corrector.reset(np.ones(4, bool))
    return corrector


def features(epochs):
    """Return random features (epochs, 4, features) of four environments."""
    return np.random.default_rng(1).normal(size=(epochs, 4, FEATURES)).astype(np.float32)


def by_pytorch(shown, units):
    """Return the corrections (epochs, 4, 6) that PyTorch computes, not yet scaled by trust."""
    torch = pytest.importorskip("torch")
    tensors = {name: torch.from_numpy(part) for name, part in network(units=units).items()}
    gru = torch.nn.GRU(FRONT, UNITS, bidirectional=units == TWO_WAY)
    names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
    ends = zip(units, ("_l0", "_l0_reverse"), strict=False)
    gru.load_state_dict({f"{n}{end}": tensors[f"{unit}.{n}"] for unit, end in ends for n in names})
    with torch.no_grad():
        linear = torch.nn.functional.linear
        front = torch.tanh(
            linear(torch.from_numpy(shown), tensors["front.weight"], tensors["front.bias"])
        )
        memory, _ = gru(front)
        both = torch.cat([memory, front], -1)
        head = torch.tanh(linear(both, tensors["head.weight"], tensors["head.bias"]))
        answer = linear(head, tensors["out.weight"], tensors["out.bias"])
    return answer.unflatten(-1, (MEMBERS, CORRECTIONS)).mean(2).numpy()


@pytest.mark.torch
def test_the_network_equals_pytorch(path):
    shown = features(20)
    corrector = started(path)
    for epoch, expected in zip(shown, by_pytorch(shown, ONE_WAY), strict=True):
        shift, log_factor, trusted = corrector.correct(epoch)
        assert_allclose(shift, expected[:, :3] * trusted[:, None], atol=1e-5)
        assert_allclose(log_factor, expected[:, 3:] * trusted[:, None], atol=1e-5)


def two_way(path):
    """Return a two-way corrector that is ready for tracks whose columns are the features NAMES."""
    return partial(TwoWayCorrector(path), PIPELINE)


@pytest.mark.torch
@pytest.mark.slow
def test_the_two_way_network_equals_pytorch(two_way_path):
    shown = features(20)
    answer = two_way(two_way_path)(np.swapaxes(shown, 0, 1))
    expected = np.swapaxes(by_pytorch(shown, TWO_WAY), 0, 1) * answer.trusted[..., None]
    both = np.concatenate([answer.shift, answer.log_factor], axis=-1)
    assert_allclose(both, expected, atol=1e-5)


def test_two_way_corrections_fade_around_strange_epochs_and_are_never_nan(two_way_path):
    tracks = np.swapaxes(features(41), 0, 1)
    usual = two_way(two_way_path)(tracks).trusted[0]
    tracks[0, 20, 5] = np.nan
    answer = two_way(two_way_path)(tracks)
    assert all(np.isfinite(part).all() for part in answer) and answer.trusted[0, 20] == 0.0
    assert (answer.trusted[0, [18, 19, 21, 22]] < 0.3).all()
    assert answer.trusted[0, [0, -1]].min() > 0.5 * usual[[0, -1]].min()


def test_a_corrector_remembers_until_an_episode_begins(path):
    corrector = started(path)
    shown = features(1)[0]
    first = corrector.correct(shown).shift
    assert (corrector.correct(shown).shift != first).any(axis=1).all()
    corrector.reset(np.array([True, False, True, False]))
    again = corrector.correct(shown).shift
    assert_array_equal(again[[0, 2]], first[[0, 2]])
    assert (again[[1, 3]] != first[[1, 3]]).any(axis=1).all()


def test_compiled_play_equals_the_verbs_called_epoch_by_epoch():
    """Check eleven tracks, which need two blocks, of two lengths."""
    switching = load("corrector")
    batch = task_from(episode_steps=30).simulated.sample_batch(np.arange(11, dtype=np.uint64))
    batch.length[::3] = 17
    played = []
    for is_compiled in (True, False):
        policy = switching.start(batch.layout)
        if not is_compiled:
            verbs = {name: getattr(policy, name) for name in ("act", "correct", "reset")}
            policy = policy_from(SimpleNamespace(**verbs), "ours")
        pipeline = switching.pipeline(batch.layout, planar=False)
        engine = Engine(pipeline, 11, None, "signed", switching.bank, policy=policy)
        engine.load(batch)
        if is_compiled:
            policy.reset(np.ones(3, bool))  # by mistake: play must begin eleven tracks
        parts = [play(engine, policy, epochs, ["x", "P", "memory.nis"]) for epochs in (12, 18)]
        played.append({name: np.hstack([part[name] for part in parts]) for name in parts[0]})
    assert np.ptp(played[0]["mode"]) > 0 and np.ptp(played[0]["trusted"]) > 0.0
    for name, values in played[0].items():
        assert_array_equal(values, played[1][name])


def test_a_corrector_that_was_not_reset_begins_new_tracks(path):
    observations = np.ones((3, FEATURES), np.float32)
    first = [Corrector(path).correct(observations).shift for _ in range(2)]
    assert_array_equal(*first)
    several = started(path)
    several.correct(observations[:1])
    assert_array_equal(several.correct(observations).shift, first[0])


def test_a_pickled_corrector_goes_on_whatever_the_layout_of_observations(path):
    first, second, third = features(3)
    plain = started(path)
    expected = [plain.correct(shown).shift for shown in (first, second, third)]
    corrector = started(path)
    corrector.correct(first)
    corrector.correct(np.asfortranarray(second))
    answer = pickle.loads(pickle.dumps(corrector)).correct(third.astype(float))
    assert_array_equal(answer.shift, expected[-1])


def test_corrections_fade_beyond_the_range_of_training_and_come_back(path):
    corrector = started(path)
    shown = features(1)[0]
    assert (corrector.correct(shown).trusted > 0.0).all()
    strange = shown.copy()
    strange[0, 3] = 9.0
    faded = corrector.correct(strange)
    assert faded.trusted[0] < 1e-3 and np.abs(faded.shift[0]).max() < 1e-2
    trusted = [corrector.correct(shown).trusted[0] for _ in range(12)]
    assert all(np.diff(trusted) >= -0.2) and trusted[-1] > 5.0 * trusted[0]


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_a_corrector_never_answers_nan(path, value):
    corrector = started(path)
    strange = features(1)[0]
    strange[1, 5] = value
    for _ in range(3):
        answer = corrector.correct(strange)
        assert all(np.isfinite(part).all() for part in answer) and answer.trusted[1] == 0.0
    healthy = corrector.correct(features(1)[0])
    assert np.isfinite(healthy.shift).all()


def test_members_that_disagree_are_not_trusted(tmp_path):
    corrector = started(write(tmp_path / "wild.safetensors", network(scale=6.0), card()))
    answers = [corrector.correct(epoch) for epoch in features(20)]
    assert np.mean([answer.trusted for answer in answers]) < 0.1
    assert max(np.abs(answer.shift).max() for answer in answers) <= MOST_SHIFT
    assert max(np.abs(answer.log_factor).max() for answer in answers) <= MOST_LOG_FACTOR


def test_features_are_found_by_name_and_anchors_may_be_missing(path):
    everything = np.random.default_rng(0).normal(size=(4, len(TABLE))).astype(np.float32)
    chosen = everything[:, [TABLE.names.index(name) for name in NAMES]]
    expected = started(path).correct(chosen).shift
    assert_allclose(started(path, TABLE).correct(everything).shift, expected, atol=1e-6)
    alone = Observation(Pipeline(MODES, Layout(1)), "signed", "per-mode")
    shift = started(path, alone).correct(np.zeros((4, len(alone)), np.float32)).shift
    assert np.isfinite(shift).all()


def test_an_environment_without_signed_features_is_refused(path):
    with refuses(path):
        Corrector(path, PER_MODE_TABLE)


def test_files_of_different_networks_are_not_confused(path, two_way_path, tmp_path):
    switcher = write_per_mode(tmp_path / "switcher.safetensors")
    assert isinstance(load(path).start(Layout()), Corrector)
    assert isinstance(load(switcher).start(Layout()), LearnedSwitch)
    readers = {switcher: LearnedSwitch, path: Corrector, two_way_path: TwoWayCorrector}
    for file, right in readers.items():
        for reader in readers.values():
            if reader is not right:
                with refuses(file):
                    reader(file)


def test_networks_with_wrong_shapes_or_nonfinite_numbers_are_refused(tmp_path):
    whole = network()
    bad = [(name, whole[name][..., :-1]) for name in ("gru.weight_hh", "out.weight", "low")]
    bad += [("low", whole["high"] + 1.0), ("head.bias", whole["head.bias"] * np.nan)]
    for name, tensor in bad:
        with refuses():
            write(tmp_path / "bad.safetensors", whole | {name: tensor}, card())
