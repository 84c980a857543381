"""Policy files: read back as written, refused when anything is wrong, never unpickled."""

import json
import pickle
import struct
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from mmwave_env.filters.bank import as_written, bank_as_written
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.update import ekf
from policies import shipped_policies
from policies.policy_file import (
    FORMAT,
    MOST_BYTES,
    MOST_HEADER,
    Card,
    _checksum,
    read_policy,
    to_bytes,
)
from tests.training.actors import (
    HANDSET,
    MODES,
    PER_MODE,
    STANDARD,
    TABLE,
    actor,
    card_of,
    write,
)

SMALL = {"features": 3, "hidden": (2,)}
READ = TABLE.columns[:3]
KINDS = {
    "plain": (actor(**SMALL), card_of(features=READ)),
    "linear": (actor(3, hidden=()), card_of(features=READ)),
    "prior": (actor(**SMALL), card_of(observation="prior", features=READ)),
    "per-mode": (actor(**SMALL, actions=4), card_of(features=READ, **PER_MODE)),
    "no transition": (
        actor(**SMALL, actions=4),
        card_of(
            features=READ, beliefs="per-mode", banks={"lab": replace(HANDSET, transition=None)}
        ),
    ),
}
TENSORS, CARD = KINDS["prior"]
WHOLE = to_bytes(TENSORS, CARD)
PER_MODE_TENSORS, PER_MODE_CARD = KINDS["per-mode"]

in_one_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "mine.safetensors"


def same(found, tensors, card):
    """Whether a file's tensors and card are those."""
    return (
        found[1] == card
        and found[0].keys() == tensors.keys()
        and all(np.array_equal(found[0][name], tensors[name]) for name in tensors)
    )


def refused(path, content, message=""):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"(?s)mine.safetensors: not a policy file: .*{message}"):
        read_policy(path)


def assembled(tensors=TENSORS, card=None, **document):
    """A file with a right checksum and no other check; entries of the document can be replaced."""
    card = CARD.as_json() if card is None else card
    whole = {"format": FORMAT, "sha256": _checksum(tensors, card), "card": card} | document
    return save(tensors, {"policy": json.dumps(whole)})


# --- what is right


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_gives_back_what_was_written(path, kind):
    tensors, card = KINDS[kind]
    found = read_policy(write(path, tensors, card))
    assert same(found, tensors, card)
    assert all(tensor.dtype == np.float32 for tensor in found[0].values())


def test_the_same_policy_makes_the_same_file():
    turned = dict(reversed(TENSORS.items()))
    assert {to_bytes(TENSORS, CARD), to_bytes(turned, CARD), assembled()} == {WHOLE}


def test_tensors_are_written_whatever_their_order_in_memory(path):
    turned = {name: np.asfortranarray(tensor) for name, tensor in TENSORS.items()}
    assert same(read_policy(write(path, turned, CARD)), TENSORS, CARD)


def test_own_modes_and_figures_of_any_form_come_back(path):
    modes = (Mode("slow", "ckf", gate=None, cost=3.0), Mode("fast", sigma_v=0.1 + 0.2))
    figures = {"mixed": {"reward": [-1.7, 0.1 + 0.2]}, "seeds": None, "10": 1, "9": 2}
    card = card_of(modes=modes, evaluation=figures, features=READ)
    assert read_policy(write(path, actor(3, actions=2), card))[1] == card
    numbered = replace(card, evaluation={10: 1, 9: (2, 3)})
    read = read_policy(write(path, actor(3, actions=2), numbered))[1]
    assert read.evaluation == {"10": 1, "9": [2, 3]}


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_file_is_written_again_to_the_last_byte(name):
    path = shipped_policies()[name]
    assert to_bytes(*read_policy(path)) == path.read_bytes()


def test_of_beliefs_per_mode_there_is_one_more_action_than_modes(path):
    assert PER_MODE_CARD.actions == ["none", "stand", "walk", "ride"]
    for actions in (3, 5):
        tensors = actor(**SMALL, actions=actions)
        message = f"layer.1.weight': found shape .{actions}, 2., expected .4, 2."
        refused(path, assembled(tensors, PER_MODE_CARD.as_json()), message)


# --- damage


@in_one_folder
@given(st.integers(0, len(WHOLE) - 1))
def test_a_file_cut_off_anywhere_is_refused(path, length):
    refused(path, WHOLE[:length])


def read_or_refused(path, content):
    """The policy, or None where the file is refused by name."""
    path.write_bytes(content)
    try:
        return read_policy(path)
    except ValueError as error:
        if not str(error).startswith(f"{path}: not a policy file: "):
            raise
        return None


@settings(in_one_folder, max_examples=200)
@given(st.integers(0, len(WHOLE) - 1), st.integers(1, 255))
def test_a_damaged_byte_is_noticed_or_means_nothing(path, place, change):
    content = bytearray(WHOLE)
    content[place] ^= change
    found = read_or_refused(path, bytes(content))
    assert found is None or same(found, TENSORS, CARD)


def document():
    return {"format": FORMAT, "sha256": _checksum(TENSORS, CARD.as_json()), "card": CARD.as_json()}


@in_one_folder
@given(st.sampled_from(sorted(TENSORS)), st.lists(st.integers(0, 5), max_size=3))
def test_a_tensor_of_another_shape_is_refused(path, name, shape):
    assume(tuple(shape) != TENSORS[name].shape)
    refused(path, assembled(TENSORS | {name: np.zeros(shape, np.float32)}), "tensor")


@pytest.mark.parametrize("kind", KINDS)
def test_every_tensor_is_needed_and_no_other(path, kind):
    tensors, card = KINDS[kind]
    for name in tensors:
        others = {other: tensor for other, tensor in tensors.items() if other != name}
        refused(path, assembled(others, card.as_json()), "tensors?")
    for name in ("critic", "layer.9.bias", "layer.x.weight", "lstm.bias_hh", ""):
        more = tensors | {name: np.zeros(3, np.float32)}
        refused(path, assembled(more, card.as_json()), "unknown .*" + name)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


@pytest.mark.slow
@settings(in_one_folder, max_examples=100)
@given(st.sampled_from(sorted(asdict(CARD))), ANYTHING)
def test_a_card_may_hold_anything_and_is_read_as_it_stands_or_refused(path, name, value):
    card = CARD.as_json() | {name: value}
    found = read_or_refused(path, assembled(card=card))
    if found is not None:
        left_out = {"beliefs": "shared", "banks": {}}  # as they are where nothing is said of them
        assert json.dumps((left_out | found[1].as_json())[name]) == json.dumps(value)


@settings(in_one_folder, max_examples=100)
@given(st.dictionaries(st.sampled_from(["name", "algorithm", "sigma_p", "gate", "?"]), ANYTHING))
def test_a_mode_may_hold_anything_and_is_read_as_it_stands_or_refused(path, mode):
    card = CARD.as_json()
    card["modes"][1] = card["modes"][1] | mode
    found = read_or_refused(path, assembled(card=card))
    if found is not None:
        assert all(getattr(found[1].modes[1], name) == value for name, value in mode.items())


@settings(in_one_folder, max_examples=100)
@given(st.sampled_from(["modes", "transition", "nis_quantile", "?"]), ANYTHING)
def test_a_bank_may_hold_anything_and_is_read_as_it_stands_or_refused(path, name, value):
    card = PER_MODE_CARD.as_json()
    card["banks"]["standard"] = card["banks"]["standard"] | {name: value}
    found = read_or_refused(path, assembled(PER_MODE_TENSORS, card))
    if found is not None:
        written = found[1].as_json()["banks"]["standard"]
        assert json.dumps(written[name]) == json.dumps(value)


@in_one_folder
@given(ANYTHING)
def test_metadata_may_hold_anything(path, value):
    refused(path, save(TENSORS, {"policy": json.dumps(value)}))


# --- what messages say


def raw(header, body=b""):
    """A file of safetensors by hand."""
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "header"),
        (pickle.dumps({"low": 1.0}), "header"),
        (b"PK\x03\x04" + bytes(200), "header"),  # PyTorch's own format is a zip archive
        (raw({}), "metadata: found nothing under 'policy', expected format, sha256, card"),
        (save(TENSORS, {"policy": "{"}), "metadata 'policy': found no JSON"),
        (save(TENSORS, {"policy": "[" * 100_000}), "metadata 'policy': found no JSON"),
        (assembled(format=1), "format: found 1, expected 2; use the version"),
        (assembled(more=1), "metadata 'policy': missing none, unknown more"),
        (assembled(sha256="0"), "sha256: found '0', expected '.*damaged"),
        (assembled(card={"seed": 1}), "card: missing algorithm, .*versions, unknown none"),
    ],
)
def test_what_is_no_policy_file_is_refused(path, content, message):
    refused(path, content, message)


@pytest.mark.parametrize("dtype", ["F64", "F16", "BF16", "F8_E4M3", "I32", "BOOL"])
def test_other_types_of_numbers_are_refused(path, dtype):
    bits = {"F64": 8, "I32": 4, "F16": 2, "BF16": 2}.get(dtype, 1)
    metadata = {"policy": json.dumps(document())}
    low = {"dtype": dtype, "shape": [3], "data_offsets": [0, 3 * bits]}
    content = raw({"__metadata__": metadata, "low": low}, bytes(3 * bits))
    refused(path, content, f"tensor 'low': found type {dtype}, expected F32")


WRONG_TENSORS = [
    ({"low": np.zeros(4, np.float32)}, "'high': found shape .3,., expected .4,."),
    ({"low": np.full(3, 99.0, np.float32)}, "'low': found numbers above 'high'"),
    ({"layer.1.bias": np.zeros(2, np.float32)}, "layer.1.bias': found shape .2,., expected .3,."),
    ({"layer.0.bias": np.float32([0.0, np.inf])}, "layer.0.bias': found NaN or infinity"),
    ({"layer.0.bias": np.zeros(2)}, "layer.0.bias': found type (F64|float64)"),
    ({"low": np.zeros(0, np.float32)}, "'low': found nothing in it, expected numbers"),
    ({"critic": np.zeros(2, np.float32)}, "tensors: missing none, unknown critic"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG_TENSORS)
def test_tensors_that_are_no_actor_are_neither_read_nor_written(path, changes, message):
    refused(path, assembled(TENSORS | changes), message)
    with pytest.raises(ValueError, match=message):
        to_bytes(TENSORS | changes, CARD)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": "1"}, "seed: found '1', expected int"),
        ({"features": (*READ[:2], READ[0])}, "features: found 3 with equal names"),
        ({"observation": "all"}, "observation: found 'all', expected one of full, prior"),
        ({"versions": {"numpy": "2.0"}}, "versions: found .*, expected one of 'mmwave-loc'"),
    ],
)
def test_a_card_of_the_wrong_kind_is_neither_read_nor_made(path, changes, message):
    refused(path, assembled(card=CARD.as_json() | changes), message)
    with pytest.raises(ValueError, match=message):
        Card(**vars(CARD) | changes)


@pytest.mark.parametrize(
    "row", [["a", "m", 0.0], ["a", 1, 0.0, 1.0], ["a", "m", 0.0, 0.0], ["a", "m", 1e999, 1.0]]
)
def test_a_feature_without_name_unit_or_scale_is_refused(path, row):
    content = CARD.as_json()
    refused(
        path, assembled(card=content | {"features": [*content["features"][:2], row]}), "features: "
    )


def test_as_many_features_as_inputs_are_needed(path):
    content = CARD.as_json()
    refused(
        path, assembled(card=content | {"features": content["features"][:2]}), "features: found 2"
    )


RENAMED = replace(STANDARD, modes=tuple(replace(mode, name=f"my {mode.name}") for mode in MODES))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"beliefs": "mine"}, "beliefs: found 'mine', expected one of shared, per-mode"),
        ({"beliefs": "shared"}, "banks: found those of handset, standard, expected none where bel"),
        ({"banks": {}}, "banks: found none, expected one or more where beliefs are 'per-mode'"),
        ({"banks": {"standard": STANDARD, "handset": HANDSET}, "modes": MODES[:2]},
         "modes: found stand, walk, expected stand, walk, ride as the first bank has them"),
        ({"banks": {"handset": HANDSET, "lab": RENAMED}},
         "bank of radio 'lab': found the modes my stand, my walk, my ride, expected stand, walk, "),
    ],
)  # fmt: skip
def test_banks_that_fit_nothing_are_neither_read_nor_made(path, changes, message):
    card = SimpleNamespace(**vars(PER_MODE_CARD) | changes)
    with pytest.raises(ValueError, match=message):
        Card(**vars(card))
    content = PER_MODE_CARD.as_json() | {"beliefs": card.beliefs}
    content["modes"] = [as_written(mode) for mode in card.modes]
    content["banks"] = {radio: bank_as_written(bank) for radio, bank in card.banks.items()}
    refused(path, assembled(PER_MODE_TENSORS, content), message)


BANK = PER_MODE_CARD.as_json()["banks"]["handset"]


@pytest.mark.parametrize(
    ("banks", "message"),
    [
        ([BANK], "banks: found .*, expected an object, a bank for each radio"),
        ({"lab": None}, "bank of radio 'lab': found None, expected an object"),
        ({"lab": BANK | {"cap": 1}}, "'lab': key: found 'cap', expected one of modes"),
        ({"lab": BANK | {"modes": []}}, "'lab': modes: found 0, expected a list of 1 to 32"),
        ({"lab": BANK | {"transition": [[1.0]]}}, "'lab': transition: .* expected 3 rows of 3"),
        ({"lab": BANK | {"transition": [[10**400]]}}, "'lab': transition: found .*inf"),
    ],
)
def test_damaged_banks_are_refused(path, banks, message):
    content = PER_MODE_CARD.as_json() | {"banks": banks}
    refused(path, assembled(PER_MODE_TENSORS, content), message)


@pytest.mark.parametrize(
    ("modes", "message"),
    [
        (None, "modes: found None, expected a list of 1 to 32"),
        ([], "modes: found 0, expected a list of 1 to 32"),
        ([{"name": "a", "algorithm": "pf"}], "'pf'.*ekf, ukf, ckf"),
        ([{"name": "a"}, {"name": "a"}], "no name twice"),
        ([{"name": "a"}], "layer.1.weight': found shape .3, 2., expected .1, 2."),
    ],
)
def test_unknown_modes_are_refused(path, modes, message):
    refused(path, assembled(card=CARD.as_json() | {"modes": modes}), message)


def test_no_file_can_hold_a_function():
    with pytest.raises(ValueError, match="algorithm of mode 'own': found a function"):
        to_bytes(actor(3, actions=1), card_of(modes=(Mode("own", ekf),), features=READ))


def test_what_a_file_says_of_its_size_is_looked_at_before_its_numbers(path):
    for header in (MOST_HEADER + 1, 2**63):
        refused(path, header.to_bytes(8, "little") + b"{}", f"found .* a header of {header}")
    with path.open("wb") as file:  # takes no room on the disk
        file.truncate(MOST_BYTES + 1)
    with pytest.raises(ValueError, match=f"found a file of {MOST_BYTES + 1} bytes"):
        read_policy(path)


def test_a_card_of_lists_in_lists_is_refused(path):
    nested = f'"modes": {"[" * 900 + "]" * 900}'
    card = json.dumps(CARD.as_json() | {"modes": 0}).replace('"modes": 0', nested)
    document = f'{{"format": {FORMAT}, "sha256": "", "card": {card}}}'
    refused(path, save(TENSORS, {"policy": document}), "found lists or objects in each other")


def test_a_missing_file_is_named(path, tmp_path):
    with pytest.raises(FileNotFoundError, match="mine.safetensors: found no such file"):
        read_policy(path)
    with pytest.raises(IsADirectoryError, match="found a folder, expected a policy"):
        read_policy(tmp_path)
