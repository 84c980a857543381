"""Observation: one table of features that defines the space, the documentation and the values.

Every feature is standardized by the mean and standard deviation of its kind. Both are constants, so
an observation has the same meaning in every environment, and networks need no normalization. Values
are limited to ten standard deviations from the mean; only rare values are beyond this limit.
"""

from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import numpy as np
from gymnasium import spaces

from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.features import Feature, View, coming, context
from mmwave_env.interface.signed import signed
from mmwave_env.io.lookup import choose
from mmwave_env.numerics.numbers import Array, Array32, Number, Numbers, Pair, clip

LIMIT = 10.0  # maximum distance of a feature from its mean, in standard deviations

OBSERVATIONS = {
    "full": "all features except signed ones",
    "prior": "as full, except features that say how well each mode explains the coming epoch",
    "signed": "as full, and signed residuals of the last epoch along and across the velocity",
}
BELIEFS = {  # a belief is a mean and a covariance
    "shared": "one belief, which the chosen mode updates",
    "per-mode": "one belief per mode; beliefs interact, and the agent raises a mode's probability",
}


def action_names(modes: Sequence[Mode], beliefs: str) -> list[str]:
    """Return names of actions: the modes, preceded by "none" if each mode has its own belief."""
    names = [mode.name for mode in modes]
    return ["none", *names] if beliefs == "per-mode" else names


class Column(NamedTuple):
    """A column of observations, which contains (value - mean) / deviation.

    Policy files list the columns that their policy reads.
    """

    name: str
    unit: str
    mean: float
    deviation: float


class Observation:
    """The table of features of an environment, in order.

    Attributes:
        features: the table.
        kind: "full", "prior" or "signed".
        beliefs: "shared" or "per-mode".
        modes: modes of the pipeline that the features describe.
    """

    def __init__(self, pipeline: Pipeline, kind: str = "full", beliefs: str = "shared") -> None:
        choose(OBSERVATIONS, kind, "observation")
        self.kind = kind
        self.modes = pipeline.modes
        self.beliefs = beliefs
        per_mode = beliefs == "per-mode"
        self.features = context(pipeline, per_mode)
        if kind != "prior":
            self.features += coming(pipeline, per_mode)
        if kind == "signed":
            self.features += signed(pipeline, per_mode)

    def only(self, features: Sequence[Feature]) -> "Observation":
        """Return a table of only these features, in the given order."""
        table = copy(self)
        table.features = list(features)
        return table

    def __len__(self) -> int:
        return len(self.features)

    @property
    def actions(self) -> list[str]:
        """Return the names of the actions."""
        return action_names(self.modes, self.beliefs)

    @property
    def names(self) -> list[str]:
        """Return the names of the features."""
        return [feature.name for feature in self.features]

    @property
    def made_with(self) -> str:
        """Describe, for messages, the environment's arguments that lead to this table."""
        modes = ", ".join(mode.name for mode in self.modes)
        return f"observation={self.kind!r}, beliefs={self.beliefs!r} and the modes {modes}"

    @property
    def space(self) -> spaces.Box:
        """Return the space of one observation, float32."""
        return spaces.Box(*np.array(self._bounds(), np.float32).T, dtype=np.float32)

    def _bounds(self) -> list[Pair]:
        """Return the limits of every standardized feature."""
        return [(_standardize(f.low, f), _standardize(f.high, f)) for f in self.features]

    @property
    def columns(self) -> tuple[Column, ...]:
        """Return the columns in their order."""
        return observation_columns(self.features)

    def read(self, observation: Array32, name: str) -> Array:
        """Return a feature in its own unit, from observations (..., features).

        The value is as exact as single precision allows; zeros and counts are exact. For a value
        beyond a limit, the limit is returned.

        Raises:
            ValueError: no feature has this name.
        """
        i = choose({feature: i for i, feature in enumerate(self.names)}, name, "feature")
        shown = observation[..., i].astype(np.float32)
        feature = self.features[i]
        value = shown.astype(np.float64) * feature.deviation + feature.mean
        # Round to the step, a power of two, with which single precision resolves such values.
        spacing = np.spacing(np.abs(shown)).astype(np.float64) * feature.deviation
        step = np.exp2(np.ceil(np.log2(spacing)))
        return np.asarray(np.rint(value / step) * step)

    def table(self) -> str:
        """Return the features as a Markdown table."""
        lines = [
            "| # | feature | meaning | unit | mean | deviation | low | high |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for i, (f, bounds) in enumerate(zip(self.features, self._bounds(), strict=True)):
            numbers = " | ".join(f"{number:.4g}" for number in (f.mean, f.deviation, *bounds))
            lines.append(f"| {i} | {f.name} | {f.meaning} | {f.unit} | {numbers} |")
        return "\n".join(lines)


def observation_columns(features: Sequence[Feature]) -> tuple[Column, ...]:
    """Return the columns of standardized features."""
    return tuple(Column(f.name, f.unit, float(f.mean), float(f.deviation)) for f in features)


def standardized(features: Sequence[Feature], view: View) -> Numbers:
    """Return the standardized values of features."""
    return [_standardize(f.value(view), f) for f in features]


def _standardize(value: Number, feature: Feature) -> Number:
    """Limit and standardize a value."""
    reach = LIMIT * feature.deviation
    low = max(feature.low, feature.mean - reach)
    high = min(feature.high, feature.mean + reach)
    return (clip(value, low, high) - feature.mean) * (1.0 / feature.deviation)
