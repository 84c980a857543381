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
from collections import Counter
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from mmwave_env import __version__
from mmwave_env.filters.bank import Bank, as_written, bank_as_written
from mmwave_env.filters.modes import Mode
from mmwave_env.interface.observation import BELIEFS, OBSERVATIONS, Column, action_names
from mmwave_env.io.files import UNEXPECTED, AnyPath, Json, first_line, parse_json, read_bounded
from mmwave_env.io.lookup import choose, quoted
from mmwave_env.io.records import Record, object_from
from mmwave_env.numerics.numbers import Array32

FORMAT = 2
# Number of outputs of each member of a corrector's ensemble: shifts of the position along, across
# and up, and logarithms of factors for the three standard deviations.
CORRECTIONS = 6
MOST_BYTES = 128 << 20  # maximum size of a file: a thousand times the size of our largest policy
MOST_WEIGHT = 1e9  # largest size of a weight; a hundred thousand times our largest one
_KEY = "policy"  # only one key, because the library would write several keys in random order
# fields that older files do not have, with the values for which files leave them out
_LATER: Json = {"beliefs": "shared", "banks": {}, "base": ""}

Tensors = dict[str, Array32]
Shapes = dict[str, tuple[int, ...]]


@dataclass(frozen=True)
class Card(Record):
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
    evaluation: dict[str, object]  # results, as JSON of any form
    versions: dict[str, str]  # versions of packages used in training, including "mmwave-loc"
    beliefs: str = "shared"  # "shared" or "per-mode"
    # if every mode has its own belief, the bank for each radio profile of the training; the modes
    # have the same names in all banks
    banks: dict[str, Bank] = field(default_factory=dict)
    # what computes the beliefs that a corrector corrects: "imm-best" for the IMM of the banks, or
    # the name of a shipped switcher; empty if the policy is itself a switcher
    base: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        choose(OBSERVATIONS, self.observation, "observation")
        choose(BELIEFS, self.beliefs, "beliefs")
        per_mode = self.beliefs == "per-mode"
        if bool(self.banks) != per_mode:
            raise ValueError(
                f"banks: found {len(self.banks)} banks with beliefs {self.beliefs!r}, expected "
                f"{'at least one' if per_mode else 'none'}"
            )

    def as_json(self) -> Json:
        """Return the card as the JSON of a policy file.

        Raises:
            ValueError: a mode's algorithm is a function, which cannot be written to a file.
        """
        banks = {radio: bank_as_written(bank) for radio, bank in self.banks.items()}
        modes = [as_written(mode) for mode in self.modes]
        content = {**asdict(self), "modes": modes, "banks": banks}
        return {k: v for k, v in content.items() if k not in _LATER or v != _LATER[k]}


@dataclass(frozen=True)
class _Document(Record):
    """The JSON object in a file's metadata."""

    format: Literal[2]
    sha256: str
    card: Card


class PolicyFile(NamedTuple):
    """The content of a policy file."""

    tensors: Tensors
    card: Card
    path: Path


def _column(row: Any) -> Column:
    """Return the column of an observation that a list [name, unit, mean, deviation] describes."""
    types = [type(value) for value in row] if isinstance(row, list) else []
    if types == [str, str, float, float] and np.isfinite(row[2]) and 0.0 < row[3] < np.inf:
        return Column(*row)
    raise ValueError(f"features: found {quoted(row)}, expected [name, unit, mean, deviation]")


def versions_of(*packages: str) -> dict[str, str]:
    """Return the versions of mmwave-loc and of the named packages, to store in a policy file."""
    return {"mmwave-loc": __version__} | {name: version(name) for name in packages}


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
    return save(tensors, {_KEY: json.dumps(document)})


def read_policy(path: AnyPath) -> PolicyFile:
    """Read a policy file.

    Raises:
        ValueError: the file is invalid; the message names the file and what is wrong in it.
        OSError: the file can't be read; FileNotFoundError if it does not exist.
    """
    path = Path(path)
    read_bounded(path, MOST_BYTES, "a policy (.safetensors)")
    try:
        with safe_open(path, "np") as file:
            content = parse_json((file.metadata() or {}).get(_KEY, "{}"))
            written = dict(content["card"])
            content["card"] = written | {"features": tuple(map(_column, written["features"]))}
            document = object_from(_Document, content)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        _require_network(tensors, document.card)
        expected = _checksum(tensors, written)
        if document.sha256 != expected:
            raise ValueError(
                f"sha256: found {quoted(document.sha256)}, expected {expected!r}; the file is "
                "damaged: copy it or train the policy again"
            )
    except (*UNEXPECTED, SafetensorError) as error:
        raise ValueError(f"{path}: not a policy file: {first_line(error)}") from error
    return PolicyFile(tensors, document.card, path)


def _require_network(tensors: Tensors, card: Card) -> None:
    """Refuse tensors that do not form the network that the card describes."""
    features = len(card.features)
    shapes = _shapes(Counter({name: tensor.size for name, tensor in tensors.items()}), card)
    if tensors.keys() != shapes.keys():
        raise ValueError(f"tensors: found {sorted(tensors)}, expected {sorted(shapes)}")
    for name, shape in shapes.items():
        tensor = tensors[name]
        limit = np.inf if name in ("low", "high") else MOST_WEIGHT
        small = np.isfinite(tensor).all() and (abs(tensor) <= limit).all()
        if tensor.shape != shape or not (tensor.dtype == np.float32 and tensor.size and small):
            raise ValueError(
                f"tensor {name!r}: found {tensor.dtype} {tensor.shape}, expected finite float32 "
                f"{shape} for {features} features, and weights up to {MOST_WEIGHT:g}"
            )
    if (tensors["low"] > tensors["high"]).any():
        raise ValueError("tensor 'low': found numbers above tensor 'high', expected none")


def _shapes(size: Counter[str], card: Card) -> Shapes:
    """Return the shapes of a network's tensors, given the sizes of all its tensors."""
    features = len(card.features)
    layers: Shapes = {}  # outputs and inputs; {} stands for the two tensors of a layer
    if card.base:
        front = size["front.bias"]
        head = size["head.bias"]
        units = size["gru.bias_ih"] // 3
        out = size["out.bias"] // CORRECTIONS * CORRECTIONS
        recurrent = ("gru", "back") if size["back.bias_ih"] else ("gru",)
        for unit in recurrent:
            layers |= {f"{unit}.{{}}_ih": (3 * units, front), f"{unit}.{{}}_hh": (3 * units, units)}
        layers["front.{}"] = (front, features)
        layers["head.{}"] = (head, front + len(recurrent) * units)
        layers["out.{}"] = (out, head)
    else:
        hidden = max(sum(name.endswith(".weight") for name in size), 1) - 1
        actions = len(action_names(card.modes, card.beliefs))
        widths = [features, *(size[f"layer.{i}.bias"] for i in range(hidden)), actions]
        layers |= {f"layer.{i}.{{}}": (out, w) for i, (w, out) in enumerate(pairwise(widths))}
    shapes: Shapes = {"low": (features,), "high": (features,)}
    for name, ends in layers.items():
        shapes |= {name.format("weight"): ends, name.format("bias"): ends[:1]}
    return shapes


def _checksum(tensors: Tensors, card: Json) -> str:
    """Compute a checksum over everything that determines a policy."""
    whole = sha256(json.dumps(card, sort_keys=True).encode())
    for name in sorted(tensors):
        whole.update(f"{name} {tensors[name].shape} ".encode())
        whole.update(tensors[name].astype("<f4").tobytes())
    return whole.hexdigest()
