"""The observation: one table of features that makes the space, the docs and the values."""

from collections.abc import Sequence
from hashlib import sha256

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mmwave_env.features import View, coming, context
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.lookup import choose
from mmwave_env.numerics.numbers import Number, clip

OBSERVATIONS = {"full": "everything", "prior": "nothing of how each mode sees the coming epoch"}

BELIEFS = {
    "shared": "one belief, which the mode chosen updates",
    "per-mode": "one belief a mode; they interact, and the agent says which to trust",
}


def action_names(modes: Sequence[Mode], beliefs: str) -> list[str]:
    """What the actions are called: the modes; where each keeps its belief, first "none"."""
    names = [mode.name for mode in modes]
    return ["none", *names] if beliefs == "per-mode" else names


class Observation:
    """The table of features of an environment, in order.

    Attributes:
        features: the table.
        kind: "full" or "prior".
        beliefs: "shared" or "per-mode".
        modes: of the pipeline that the features describe.
    """

    def __init__(self, pipeline: Pipeline, kind: str = "full", beliefs: str = "shared") -> None:
        if kind not in OBSERVATIONS:
            raise ValueError(f"observation: found {kind!r}, expected one of {list(OBSERVATIONS)}")
        self.kind, self.modes, self.beliefs = kind, pipeline.modes, beliefs
        choose(BELIEFS, beliefs, "beliefs")
        per_mode = beliefs == "per-mode"
        self.features = context(pipeline, per_mode)
        if kind == "full":
            self.features += coming(pipeline, per_mode)
        self._index = {feature.name: i for i, feature in enumerate(self.features)}

    def __len__(self) -> int:
        return len(self.features)

    @property
    def actions(self) -> list[str]:
        """What the actions are called."""
        return action_names(self.modes, self.beliefs)

    @property
    def made_with(self) -> str:
        """The arguments of the environment that make this table, for messages."""
        modes = ", ".join(mode.name for mode in self.modes)
        return f"observation={self.kind!r}, beliefs={self.beliefs!r} and the modes {modes}"

    @property
    def space(self) -> spaces.Box:
        """The Box of one observation, float32."""
        low = np.array([f.low for f in self.features], np.float32)
        high = np.array([f.high for f in self.features], np.float32)
        return spaces.Box(low, high, dtype=np.float32)

    @property
    def digest(self) -> str:
        """A name for the table: all that learned weights depend on, but for the modes' tuning."""
        rows = [
            (f.name, f.meaning, f.unit, float(f.scale), float(f.low), float(f.high))
            for f in self.features
        ]
        return sha256(repr(rows).encode()).hexdigest()[:16]

    def values(self, view: View) -> list[Number]:
        """The observation as numbers."""
        return [clip(f.value(view) * (1.0 / f.scale), f.low, f.high) for f in self.features]

    def read(self, observation: NDArray[np.float32], name: str) -> NDArray[np.float64]:
        """A feature in its own unit, from observations (..., features).

        Raises:
            KeyError: there is no feature of that name; the message lists those there are.
        """
        if name not in self._index:
            raise KeyError(f"feature {name!r}: expected one of {', '.join(self._index)}")
        i = self._index[name]
        return observation[..., i].astype(np.float64) * self.features[i].scale

    def table(self) -> str:
        """The features as a Markdown table."""
        lines = [
            "| # | feature | meaning | unit | scale | low | high |",
            "|---|---|---|---|---|---|---|",
        ]
        for i, f in enumerate(self.features):
            lines.append(
                f"| {i} | {f.name} | {f.meaning} | {f.unit} | {f.scale:g} | {f.low:g} "
                f"| {f.high:g} |"
            )
        return "\n".join(lines)
