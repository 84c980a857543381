"""Tests that policy files (tensors and a card of metadata) are read as written, or refused."""

import json
import pickle
import struct
from dataclasses import asdict, replace
from functools import reduce
from operator import getitem

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from mmwave_env.filters import Mode
from policies import shipped_policies
from policies.policy_file import (
    FORMAT,
    MOST_BYTES,
    _checksum,
    read_policy,
    to_bytes,
)
from tests.refusals import refuses
from tests.training.actors import HANDSET, STANDARD, TABLE, actor, card_of, write

SMALL = {"features": 3, "hidden": (2,)}
READ = TABLE.columns[:3]  # the features that the policies below read
PLAIN = replace(STANDARD, transition=None)  # a bank without transition probabilities
KINDS = {
    "plain": (actor(**SMALL), card_of(features=READ)),
    "linear": (actor(3, hidden=()), card_of(features=READ)),
    "prior": (actor(**SMALL), card_of(observation="prior", features=READ)),
    "per-mode": (
        actor(**SMALL, actions=4),
        card_of(features=READ, beliefs="per-mode", banks={"handset": HANDSET, "standard": PLAIN}),
    ),
}
every_kind = pytest.mark.parametrize("kind", KINDS)
TENSORS, CARD = KINDS["prior"]
WHOLE = to_bytes(TENSORS, CARD)
PER_MODE_TENSORS, PER_MODE_CARD = KINDS["per-mode"]

in_one_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "mine.safetensors"


def same(policy, tensors, card):
    """Return whether a policy that was read has exactly these tensors and this card."""
    equal = all(np.array_equal(policy.tensors[name], tensors[name]) for name in tensors)
    return policy.card == card and policy.tensors.keys() == tensors.keys() and equal


def refused(path, content, *fields):
    """Check that a file with this content causes an error that names the file and the fields."""
    path.write_bytes(content)
    with refuses(path, *fields):
        read_policy(path)


def document(tensors=TENSORS, card=None, **changes):
    """Return a file's metadata as JSON; the checksum is right unless ``changes`` replaces it."""
    card = CARD.as_json() if card is None else card
    whole = {"format": FORMAT, "sha256": _checksum(tensors, card), "card": card}
    return {"policy": json.dumps(whole | changes)}


def assembled(tensors=TENSORS, card=None, **changes):
    """Return a file's content, made without the checks of ``to_bytes``; see :func:`document`."""
    return save(tensors, document(tensors, card, **changes))


@every_kind
def test_a_policy_file_is_read_back_as_it_was_written(path, kind):
    tensors, card = KINDS[kind]
    policy = read_policy(write(path, tensors, card))
    assert same(policy, tensors, card)
    assert all(tensor.dtype == np.float32 for tensor in policy.tensors.values())


def test_the_same_policy_makes_the_same_file_for_any_order_in_memory():
    turned = {name: np.asfortranarray(tensor) for name, tensor in reversed(TENSORS.items())}
    assert {to_bytes(TENSORS, CARD), to_bytes(turned, CARD), assembled()} == {WHOLE}


def test_custom_modes_and_evaluations_of_any_form_are_read_back(path):
    modes = (Mode("slow", "ckf", gate=None, cost=3.0), Mode("fast", sigma_v=0.1 + 0.2))
    figures = {"mixed": {"reward": [-1.7, 0.1 + 0.2]}, "seeds": None, "10": 1, "9": 2}
    card = card_of(modes=modes, evaluation=figures, features=READ)
    assert read_policy(write(path, actor(3, actions=2), card)).card == card
    numbered = replace(card, evaluation={10: 1, 9: (2, 3)})
    read = read_policy(write(path, actor(3, actions=2), numbered))
    assert read.card.evaluation == {"10": 1, "9": [2, 3]}


@pytest.mark.parametrize("name", shipped_policies())
def test_a_shipped_file_that_is_written_again_has_the_same_bytes(name):
    policy = read_policy(shipped_policies()[name])
    assert to_bytes(policy.tensors, policy.card) == policy.path.read_bytes()


def test_a_policy_with_beliefs_per_mode_has_one_more_action_than_modes(path):
    for actions in (3, 5):
        tensors = actor(**SMALL, actions=actions)
        refused(path, assembled(tensors, PER_MODE_CARD.as_json()), "layer.1.weight")


def read_or_refused(path, content):
    """Return the policy in a file, or None if reading raises an error that names the file."""
    path.write_bytes(content)
    try:
        return read_policy(path)
    except ValueError as error:
        if not str(error).startswith(f"{path}: not a policy file: "):
            raise
        return None


@settings(in_one_folder, max_examples=200)
@given(st.integers(0, len(WHOLE) - 1), st.integers(1, 255))
def test_a_file_with_a_damaged_byte_is_refused_or_read_unchanged(path, place, change):
    content = bytearray(WHOLE)
    content[place] ^= change
    policy = read_or_refused(path, bytes(content))
    assert policy is None or same(policy, TENSORS, CARD)


@every_kind
def test_missing_and_additional_tensors_are_refused(path, kind):
    tensors, card = KINDS[kind]
    for name in tensors:
        others = {other: tensor for other, tensor in tensors.items() if other != name}
        refused(path, assembled(others, card.as_json()))
    for name in ("critic", "layer.9.bias", "layer.x.weight", "lstm.bias_hh", ""):
        more = tensors | {name: np.zeros(3, np.float32)}
        refused(path, assembled(more, card.as_json()))
        with refuses():
            to_bytes(more, card)


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


DEFAULTS = {"beliefs": "shared", "banks": {}, "base": ""}  # values of fields that files may omit
PLACES = {  # path to a part of a card -> keys of this part; no card has the key "?"
    (): sorted(asdict(PER_MODE_CARD)),
    ("modes", 1): ["name", "algorithm", "sigma_p", "gate", "?"],
    ("banks", "standard"): ["modes", "transition", "nis_quantile", "?"],
}


@pytest.mark.parametrize("place", PLACES)
@settings(in_one_folder, max_examples=100)
@given(st.data())
def test_a_card_with_any_value_is_read_unchanged_or_refused(path, place, data):
    key = data.draw(st.sampled_from(PLACES[place]))
    value = data.draw(ANYTHING)
    card = PER_MODE_CARD.as_json()
    reduce(getitem, place, card)[key] = value
    policy = read_or_refused(path, assembled(PER_MODE_TENSORS, card))
    if policy is not None:
        read = reduce(getitem, place, DEFAULTS | policy.card.as_json())
        if type(value) is int and isinstance(read[key], float):
            value = float(value)  # 0 may become 0.0, but True may not become 1
        assert json.dumps(read[key]) == json.dumps(value)


def raw(header, body=b""):
    """Return the content of a safetensors file with this header."""
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


@pytest.mark.parametrize(
    ("content", "fields"),
    [
        (b"", []),
        (pickle.dumps({"low": 1.0}), []),
        (raw({}), ["card"]),
        (save(TENSORS, {"policy": "{"}), []),
        (save(TENSORS, {"policy": "[" * 100_000}), []),
        (assembled(format=1), ["format"]),
        (assembled(more=1), []),
        (assembled(sha256="0"), ["sha256"]),
        (assembled(card={"seed": 1}), []),
    ],
)
def test_a_file_that_is_not_a_policy_file_is_refused(path, content, fields):
    refused(path, content, *fields)


def test_a_tensor_of_a_type_that_numpy_lacks_is_refused(path):
    low = {"dtype": "BF16", "shape": [3], "data_offsets": [0, 6]}
    refused(path, raw({"__metadata__": document(), "low": low}, bytes(6)))


WRONG_TENSORS = [
    ({"low": np.zeros(4, np.float32)}, ["low"]),
    ({"low": np.full(3, 99.0, np.float32)}, ["low"]),
    ({"layer.1.bias": np.zeros(2, np.float32)}, ["layer.1.bias"]),
    ({"layer.0.bias": np.float32([0.0, np.inf])}, ["layer.0.bias"]),
    ({"layer.0.bias": np.float32([0.0, 1e30])}, ["layer.0.bias"]),
    ({"layer.0.bias": np.zeros(2)}, ["layer.0.bias"]),
    ({"layer.0.bias": np.zeros(2, np.int32)}, ["layer.0.bias"]),
    ({"low": np.zeros(0, np.float32)}, ["low"]),
]


@pytest.mark.parametrize(("changes", "fields"), WRONG_TENSORS)
def test_wrong_tensors_are_neither_read_nor_written(path, changes, fields):
    refused(path, assembled(TENSORS | changes), *fields)
    with refuses(*fields):
        to_bytes(TENSORS | changes, CARD)


@pytest.mark.parametrize(
    "rows",
    [[], [["a", "m", 0.0]], [["a", 1, 0.0, 1.0]], [["a", "m", 0.0, 0.0]], [["a", "m", 1e999, 1.0]]],
)
def test_missing_features_and_invalid_names_units_and_scales_are_refused(path, rows):
    content = CARD.as_json()
    features = [*content["features"][:2], *rows]
    refused(path, assembled(card=content | {"features": features}), "features")


BANK = PER_MODE_CARD.as_json()["banks"]["handset"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"seed": "1"}, "seed"),
        ({"observation": "all"}, "observation"),
        ({"beliefs": "mine"}, "beliefs"),
        ({"beliefs": "shared"}, "banks"),
        ({"banks": {}}, "banks"),
        ({"banks": [BANK]}, "banks"),
        ({"banks": {"lab": None}}, "banks"),
        ({"banks": {"lab": BANK | {"cap": 1}}}, "'lab'"),
        ({"banks": {"lab": BANK | {"transition": [[1.0]]}}}, "'lab'].transition"),
    ],
)
def test_a_card_with_a_wrong_field_is_refused(path, change, field):
    refused(path, assembled(PER_MODE_TENSORS, PER_MODE_CARD.as_json() | change), field)


def test_a_file_that_is_too_large_is_refused_before_its_tensors_are_read(path):
    refused(path, (2**63).to_bytes(8, "little") + b"{}")
    with path.open("wb") as file:  # a sparse file takes no space on the disk
        file.truncate(MOST_BYTES + 1)
    with refuses(path, error=OSError):
        read_policy(path)
