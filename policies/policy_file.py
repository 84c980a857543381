"""Policy files: a learned policy as ``.safetensors``, which is read without unpickling.

The tensors, all float32, describe a network. The network of a *switcher* chooses actions:

- ``low``, ``high`` (features,): observations are clipped to these limits. The first weights include
  the normalization of features during training;
- ``layer.0.weight`` (out, in), ``layer.0.bias`` (out,), ``layer.1.weight``, ...: an MLP with
  tanh between its layers. The first ``in`` is the number of features, the last ``out`` the number
  of actions. The actions are the modes; if every mode has its own belief, "none" precedes them.

The network of a *corrector* corrects the beliefs of its *base*, which is a switcher or an IMM:

- ``low``, ``high`` (features,): features are clipped to these limits; ``front`` normalizes them;
- ``front``, ``head``, ``out``: layers with a ``.weight`` (out, in) and a ``.bias`` (out,);
- ``gru.weight_ih``, ``gru.weight_hh``, ``gru.bias_ih``, ``gru.bias_hh``: the gated recurrent unit
  between ``front`` and ``head``, as PyTorch stores it: gates in the order reset, update, new;
- ``back.weight_ih``, ...: a second such unit, which reads the epochs backwards; only files for
  smoothed tracks contain this unit.

The file's metadata contain, under the key "policy", a JSON object with the version of this format,
the :class:`Card` and a checksum of card and tensors.
"""

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, get_origin, get_type_hints

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from mmwave_env.filters.bank import Bank, as_written, bank_as_written, bank_in
from mmwave_env.filters.modes import Mode
from mmwave_env.interface.observation import BELIEFS, OBSERVATIONS, Column, action_names
from mmwave_env.io.files import AnyPath, Json, first_line, naming, open_regular, parse_json
from mmwave_env.io.lookup import choose, quoted
from mmwave_env.numerics.numbers import Array32

FORMAT = 2
# Number of outputs of each member of a corrector's ensemble: shifts of the position along, across
# and up, and logarithms of factors for the three standard deviations.
CORRECTIONS = 6
MOST_BYTES = 128 << 20  # maximum size of a file: a thousand times the size of our largest policy
MOST_HEADER = 16 << 20  # maximum size of the header, which contains names, shapes and the card
_KEY = "policy"  # only one key, because the library would write several keys in random order
_PER_MODE = ("beliefs", "banks")  # fields that files leave out if the belief is shared
_LATER = (*_PER_MODE, "base")  # fields that older files do not have

Tensors = dict[str, Array32]


@dataclass(frozen=True)
class Card:
    """The description of a policy and its training, stored in the policy's file.

    Raises:
        ValueError: a field is invalid; the message says what is wrong.
    """

    # modes that the actions choose; if every mode has its own belief, these are the modes of the
    # first bank, and the actions begin with "none"
    modes: tuple[Mode, ...]
    observation: str  # "full", "prior" or "signed"
    # names, units and scales of the features that the network reads, in the network's order
    features: tuple[Column, ...]
    scenario: str  # scenario of the training
    radio: str  # radio profile of the training
    algorithm: str  # algorithm of the training
    seed: int  # seed of the training; -1 if it had none
    timesteps: int  # number of epochs of the training
    command: str  # command that made the file
    evaluation: Json  # results, as JSON of any form
    versions: dict[str, str]  # versions of packages used in training, including "mmwave-loc"
    beliefs: str = "shared"  # "shared" or "per-mode"
    # if every mode has its own belief, the bank for each radio profile of the training; the modes
    # have the same names in all banks
    banks: dict[str, Bank] = field(default_factory=dict)
    # what computes the beliefs that a corrector corrects: "imm-best" for the IMM of the banks, or
    # the name of a shipped switcher; empty if the policy is itself a switcher
    base: str = ""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(Card).items():
            value = getattr(self, name)
            expected = get_origin(hint) or hint
            if type(value) is not expected:
                raise ValueError(f"{name}: found {quoted(value)}, expected {expected.__name__}")
        choose(OBSERVATIONS, self.observation, "observation")
        names = [column.name for column in self.features]
        if len(set(names)) < len(names):
            raise ValueError("features: found a name more than once, expected different names")
        if not isinstance(self.versions.get("mmwave-loc"), str):
            raise ValueError(f"versions: found {self.versions!r}, expected 'mmwave-loc' among them")
        choose(BELIEFS, self.beliefs, "beliefs")
        if self.beliefs == "per-mode":
            self._require_banks()
        elif self.banks:
            raise ValueError(
                f"banks: found banks for {', '.join(self.banks)}, expected none if beliefs are "
                "'shared'"
            )

    def _require_banks(self) -> None:
        """Refuse banks that do not agree with each other or with the modes."""
        if not self.banks:
            raise ValueError("banks: found none, expected at least one if beliefs are 'per-mode'")
        first, *_ = self.banks.values()
        if self.modes != first.modes:
            raise ValueError(
                f"modes: found {_names(self.modes)}, expected {_names(first.modes)} with the same "
                "tuning as in the first bank"
            )
        for radio, bank in self.banks.items():
            if _names(bank.modes) != _names(self.modes):
                raise ValueError(
                    f"bank of radio {radio!r}: found the modes {_names(bank.modes)}, expected "
                    f"{_names(self.modes)}"
                )

    @property
    def actions(self) -> list[str]:
        """Return the names of the actions."""
        return action_names(self.modes, self.beliefs)

    @classmethod
    def from_json(cls, content: Any) -> "Card":
        """Return the card described by a policy file's JSON.

        Raises:
            ValueError: the JSON does not describe a card; the message says what is wrong.
        """
        if not isinstance(content, dict):
            raise ValueError(f"card: found {quoted(content)}, expected an object")
        _require_names("card", {*content, *_LATER}, [field.name for field in fields(cls)])
        alone = bank_in({"modes": content["modes"]})
        banks = _banks_in(content.get("banks", {}))
        features = tuple(map(_column, content["features"]))
        return cls(**{**content, "modes": alone.modes, "banks": banks, "features": features})

    def as_json(self) -> Json:
        """Return the card as the JSON of a policy file.

        Raises:
            ValueError: a mode's algorithm is a function, which cannot be written to a file.
        """
        banks = {radio: bank_as_written(bank) for radio, bank in self.banks.items()}
        modes = [as_written(mode) for mode in self.modes]
        content = {**asdict(self), "modes": modes, "banks": banks}
        absent = {*(() if banks else _PER_MODE), *(() if self.base else ("base",))}
        return {name: value for name, value in content.items() if name not in absent}


class PolicyFile(NamedTuple):
    """The content of a policy file."""

    path: Path
    tensors: Tensors
    card: Card


def _column(row: Any) -> Column:
    """Return the column of an observation that a list [name, unit, mean, deviation] describes."""
    types = [type(value) for value in row] if isinstance(row, list) else []
    if types == [str, str, float, float] and np.isfinite(row[2]) and 0.0 < row[3] < np.inf:
        return Column(*row)
    raise ValueError(f"features: found {quoted(row)}, expected [name, unit, mean, deviation]")


def _banks_in(content: Any) -> dict[str, Bank]:
    """Return the banks of a card in a policy file."""
    if not isinstance(content, dict):
        raise ValueError(
            f"banks: found {quoted(content)}, expected an object with a bank for each radio"
        )
    banks = {}
    for radio, bank in content.items():
        where = f"bank of radio {quoted(radio)}"
        try:
            banks[radio] = bank_in(bank)
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error
    return banks


def _names(modes: Iterable[Mode]) -> str:
    return ", ".join(mode.name for mode in modes)


def to_bytes(tensors: Tensors, card: Card) -> bytes:
    """Return a policy file's content; it depends only on the tensors and the card.

    Raises:
        ValueError: :func:`read_policy` would refuse the content.
    """
    _require_network(tensors, card)
    # The library writes the memory of an array as it is, and so would undo a transposition.
    tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
    content = json.loads(json.dumps(card.as_json()))  # as it will be read: tuples become lists
    document = {"format": FORMAT, "sha256": _checksum(tensors, content), "card": content}
    written: bytes = save(tensors, {_KEY: json.dumps(document)})
    return written


def read_policy(path: AnyPath) -> tuple[Tensors, Card]:
    """Read tensors and card of a policy file.

    Raises:
        ValueError: the file is invalid; the message names the file and what is wrong in it.
        OSError: the file can't be read; FileNotFoundError if it does not exist.
    """
    path = Path(path)
    _require_header(path)
    try:
        with safe_open(path, "np") as file:
            document = _document((file.metadata() or {}).get(_KEY))
            card = Card.from_json(document["card"])
            tensors = {name: _tensor(file, name) for name in file.keys()}  # noqa: SIM118
        _require_network(tensors, card)
        expected = _checksum(tensors, document["card"])
        if document["sha256"] != expected:
            raise ValueError(
                f"sha256: found {quoted(document['sha256'])}, expected {expected!r}; the file is "
                "damaged: copy it or train the policy again"
            )
    # A card with unexpected content may cause any of these errors in the code above.
    except (ValueError, TypeError, AttributeError, LookupError, SafetensorError) as error:
        raise ValueError(f"{path}: not a policy file: {first_line(error)}") from error
    return tensors, card


def _require_header(path: Path) -> None:
    """Refuse a file if it or its header is too large, before its data are read."""
    with open_regular(path, "a policy (.safetensors)") as file, naming(path):
        size = os.fstat(file.fileno()).st_size
        header = int.from_bytes(file.read(8), "little")
    if size > MOST_BYTES or header > MOST_HEADER:
        sizes = f"a file of {size} bytes with a header of {header}"
        most = f"at most {MOST_BYTES} and {MOST_HEADER}"
        raise ValueError(f"{path}: not a policy file: found {sizes}, expected {most}")


def _document(text: str | None) -> Json:
    """Return the JSON object of the metadata."""
    if text is None:
        raise ValueError(f"metadata: found nothing under {_KEY!r}, expected format, sha256, card")
    try:
        document = parse_json(text)
    except ValueError as error:
        raise ValueError(f"metadata {_KEY!r}: found text that is not JSON: {error}") from error
    if not isinstance(document, dict):
        raise ValueError(f"metadata {_KEY!r}: found {quoted(document)}, expected an object")
    if document.get("format") != FORMAT:
        raise ValueError(
            f"format: found {quoted(document.get('format'))}, expected {FORMAT}; use the version "
            "of mmwave-loc that wrote the file, or train the policy again"
        )
    _require_names(f"metadata {_KEY!r}", document, ("format", "sha256", "card"))
    return document


def _tensor(file: Any, name: str) -> Array32:
    """Return a tensor of an open file; refuse types except float32, as numpy lacks some of them."""
    dtype = file.get_slice(name).get_dtype()
    if dtype != "F32":
        raise ValueError(f"tensor {name!r}: found type {dtype}, expected F32")
    tensor: Array32 = file.get_tensor(name)
    return tensor


def _require_network(tensors: Tensors, card: Card) -> None:
    """Refuse tensors that do not form the network that the card describes."""
    shapes = (_corrector_shapes if card.base else _actor_shapes)(tensors, card)
    _require_names("tensors", tensors, shapes)
    for name, shape in shapes.items():
        tensor = tensors[name]
        if tensor.dtype != np.float32:
            raise ValueError(f"tensor {name!r}: found type {tensor.dtype}, expected float32")
        if not tensor.size:
            raise ValueError(f"tensor {name!r}: found an empty tensor, expected numbers")
        if tensor.shape != shape:
            raise ValueError(f"tensor {name!r}: found shape {tensor.shape}, expected {shape}")
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r}: found NaN or infinity, expected finite numbers")
    if len(card.features) != tensors["low"].size:
        raise ValueError(
            f"features: found {len(card.features)}, expected {tensors['low'].size}, the size of "
            "the tensor 'low'"
        )
    if (tensors["low"] > tensors["high"]).any():
        raise ValueError("tensor 'low': found numbers above tensor 'high', expected none")


def _actor_shapes(tensors: Tensors, card: Card) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a switcher's tensors, given its numbers of features, layers, neurons."""
    size = {name: tensor.size for name, tensor in tensors.items()}
    features = size.get("low", 0)
    shapes: dict[str, tuple[int, ...]] = {"low": (features,), "high": (features,)}
    width = features
    layers = sum(name.startswith("layer.") and name.endswith(".weight") for name in tensors)
    for i in range(max(layers, 1)):
        out = size.get(f"layer.{i}.bias", 0) if i < layers - 1 else len(card.actions)
        shapes[f"layer.{i}.weight"] = (out, width)
        shapes[f"layer.{i}.bias"] = (out,)
        width = out
    return shapes


def _corrector_shapes(tensors: Tensors, card: Card) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a corrector's tensors, given its numbers of features and neurons."""
    size = {name: tensor.size for name, tensor in tensors.items()}
    features = size.get("low", 0)
    front = size.get("front.bias", 0)
    head = size.get("head.bias", 0)
    gates = size.get("gru.bias_ih", 0)
    out = size.get("out.bias", 0)
    gates = max(gates - gates % 3, 3)
    out = max(out - out % CORRECTIONS, CORRECTIONS)
    units = ("gru", "back") if any(name.startswith("back.") for name in tensors) else ("gru",)
    recurrent: dict[str, tuple[int, ...]] = {}
    for unit in units:
        recurrent |= {
            f"{unit}.weight_ih": (gates, front),
            f"{unit}.weight_hh": (gates, gates // 3),
            f"{unit}.bias_ih": (gates,),
            f"{unit}.bias_hh": (gates,),
        }
    return recurrent | {
        "low": (features,),
        "high": (features,),
        "front.weight": (front, features),
        "front.bias": (front,),
        "head.weight": (head, front + len(units) * gates // 3),
        "head.bias": (head,),
        "out.weight": (out, head),
        "out.bias": (out,),
    }


def _require_names(group: str, names: Iterable[str], expected: Iterable[str]) -> None:
    """Refuse missing and unknown names."""
    names = set(names)
    expected = set(expected)
    if names != expected:
        raise ValueError(
            f"{group}: missing {', '.join(sorted(expected - names)) or 'none'}, "
            f"unknown {', '.join(sorted(names - expected)) or 'none'}"
        )


def _checksum(tensors: Tensors, card: Json) -> str:
    """Compute a checksum over everything that determines a policy."""
    whole = sha256(json.dumps(card, sort_keys=True).encode())
    for name in sorted(tensors):
        whole.update(f"{name} {tensors[name].shape} ".encode())
        whole.update(tensors[name].astype("<f4").tobytes())
    return whole.hexdigest()
