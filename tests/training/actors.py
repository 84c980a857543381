"""Small actors (networks that choose actions) with random weights, and their policy files."""

from dataclasses import replace

import numpy as np

from mmwave_env.filters import Mode, Pipeline
from mmwave_env.filters.bank import Bank
from mmwave_env.interface.observation import Observation
from mmwave_env.models.layout import Layout
from policies.policy_file import Card, to_bytes

MODES = (Mode("stand", sigma_v=0.1), Mode("walk"), Mode("ride", sigma_v=2.0))  # fast to compile
PIPELINE = Pipeline(MODES, Layout())
TABLE = Observation(PIPELINE)
FEATURES = len(TABLE)

HANDSET = Bank(MODES, ((0.8, 0.1, 0.1), (0.2, 0.7, 0.1), (0.3, 0.3, 0.4)), 0.999)
STANDARD = replace(HANDSET, modes=(replace(MODES[0], sigma_v=0.05), *MODES[1:]), nis_quantile=1.0)
PER_MODE = {"beliefs": "per-mode", "banks": {"handset": HANDSET, "standard": STANDARD}}
PER_MODE_TABLE = Observation(PIPELINE, "full", "per-mode")


def card_of(table=TABLE, **changes):
    """Return the card (metadata of a policy file) that a trainer writes for a table of features."""
    card = Card(
        *(table.modes, table.kind, table.columns, "mixed", "handset", "PPO", 10_000_000, 1000),
        *("mmwave-loc train", {"reward": -1.75}, {"mmwave-loc": "0.1.0"}),
    )
    return replace(card, **changes)


def actor(features=FEATURES, actions=3, hidden=(5, 4), seed=0):
    """Return the tensors of an actor, by their names in a policy file."""
    rng = np.random.default_rng(seed)

    def draw(*shape):
        """Draw weights so that neurons neither vanish nor saturate."""
        scale = 2.0 / shape[1] ** 0.5 if len(shape) > 1 else 0.2
        return rng.normal(0.0, scale, shape).astype(np.float32)

    tensors = {"low": -0.5 - draw(features) ** 2, "high": 0.5 + draw(features) ** 2}
    width = features
    for i, out in enumerate((*hidden, actions)):
        tensors |= {f"layer.{i}.weight": draw(out, width), f"layer.{i}.bias": draw(out)}
        width = out
    return tensors


def write_per_mode(path, **changes):
    """Write the policy file of an actor for one belief per mode; return its path."""
    tensors = actor(len(PER_MODE_TABLE), actions=4)
    return write(path, tensors, card_of(PER_MODE_TABLE, **PER_MODE | changes))


def write(path, tensors, card):
    """Write a policy file; return its path."""
    path.write_bytes(to_bytes(tensors, card))
    return path
