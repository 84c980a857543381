"""Observation: one table of features that defines the space, the documentation and the values.

Every feature is standardized by the mean and standard deviation of its kind. Both are constants, so
an observation has the same meaning in every environment, and networks need no normalization. Values
are limited to ten standard deviations from the mean; only rare values are beyond this limit.
"""

import inspect
import json
from collections.abc import Sequence
from copy import copy
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from gymnasium import spaces

from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.features import Feature, View, coming, context
from mmwave_env.interface.signed import signed
from mmwave_env.io.lookup import choose
from mmwave_env.models.radio import TUNED_RADIOS
from mmwave_env.numerics.numbers import Array, Array32, Number, clip

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


class Scale(NamedTuple):
    """The mean and standard deviation, in a feature's unit, that standardize the feature."""

    mean: float
    deviation: float


@cache
def feature_scales() -> dict[str, Scale]:
    """Read mean and standard deviation of every kind of feature from data/feature_scales.json."""
    # Measured 2026-11-23 (commit 476d657): 24 episodes with random actions for each combination of
    # scene, radio, kind of beliefs and set of modes (two modes, without and with odometry; eight
    # modes; the radio's bank). The file has medians over the combinations. No value was clipped.
    text = files("mmwave_env").joinpath("data/feature_scales.json").read_text(encoding="utf-8")
    return {kind: Scale(**scale) for kind, scale in json.loads(text)["kinds"].items()}


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
        scales: mean and deviation of each feature.
        kind: "full", "prior" or "signed".
        beliefs: "shared" or "per-mode".
        modes: modes of the pipeline that the features describe.
    """

    def __init__(self, pipeline: Pipeline, kind: str = "full", beliefs: str = "shared") -> None:
        choose(OBSERVATIONS, kind, "observation")
        self.kind = kind
        self.modes = pipeline.modes
        self.beliefs = beliefs
        choose(BELIEFS, beliefs, "beliefs")
        per_mode = beliefs == "per-mode"
        self.features = context(pipeline, per_mode)
        if kind != "prior":
            self.features += coming(pipeline, per_mode)
        if kind == "signed":
            self.features += signed(pipeline, per_mode)
        self._take(self.features)

    def _take(self, features: list[Feature]) -> None:
        self.features = features
        self.scales = [feature_scales()[feature.kind] for feature in self.features]
        self._rows = list(zip(self.features, self.scales, strict=True))
        self._index = {feature.name: i for i, feature in enumerate(self.features)}

    def only(self, features: Sequence[Feature]) -> "Observation":
        """Return a table of only these features, in the given order."""
        table = copy(self)
        table._take(list(features))
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
        return list(self._index)

    @property
    def made_with(self) -> str:
        """Describe, for messages, the environment's arguments that lead to this table."""
        modes = ", ".join(mode.name for mode in self.modes)
        return f"observation={self.kind!r}, beliefs={self.beliefs!r} and the modes {modes}"

    @property
    def space(self) -> spaces.Box:
        """Return the space of one observation, float32."""
        return spaces.Box(*np.array(self._bounds(), np.float32).T, dtype=np.float32)

    def _bounds(self) -> list[tuple[Number, Number]]:
        """Return the limits of every standardized feature."""
        return [(_standardize(f.low, f, s), _standardize(f.high, f, s)) for f, s in self._rows]

    @property
    def columns(self) -> tuple[Column, ...]:
        """Return the columns in their order."""
        return observation_columns(self.features)

    def values(self, view: View) -> list[Number]:
        """Return the standardized values of all features."""
        return standardized(self.features, view)

    def read(self, observation: Array32, name: str) -> Array:
        """Return a feature in its own unit, from observations (..., features).

        The value is as exact as single precision allows; zeros and counts are exact. For a value
        beyond a limit, the limit is returned.
        """
        i = self._index[name]
        shown = observation[..., i].astype(np.float32)
        (mean, deviation) = self.scales[i]
        value = shown.astype(np.float64) * deviation + mean
        # Round to the step, a power of two, with which single precision resolves such values.
        step = np.exp2(np.ceil(np.log2(np.spacing(np.abs(shown)).astype(np.float64) * deviation)))
        return np.asarray(np.rint(value / step) * step)

    def table(self) -> str:
        """Return the features as a Markdown table."""
        lines = [
            "| # | feature | meaning | unit | mean | deviation | low | high |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for i, ((f, scale), bounds) in enumerate(zip(self._rows, self._bounds(), strict=True)):
            numbers = " | ".join(f"{number:.4g}" for number in (*scale, *bounds))
            lines.append(f"| {i} | {f.name} | {f.meaning} | {f.unit} | {numbers} |")
        return "\n".join(lines)


def observation_columns(features: Sequence[Feature]) -> tuple[Column, ...]:
    """Return the columns of standardized features."""
    scales = feature_scales()
    return tuple(Column(f.name, f.unit, *map(float, scales[f.kind])) for f in features)


def standardized(features: Sequence[Feature], view: View) -> list[Number]:
    """Return the standardized values of features."""
    return [_standardize(f.value(view), f, feature_scales()[f.kind]) for f in features]


def _standardize(value: Number, feature: Feature, scale: Scale) -> Number:
    """Limit and standardize a value."""
    reach = LIMIT * scale.deviation
    low = max(feature.low, scale.mean - reach)
    high = min(feature.high, scale.mean + reach)
    return (clip(value, low, high) - scale.mean) * (1.0 / scale.deviation)


def with_modes(docstring: str) -> str:
    """Replace ``{modes}`` by a table of default modes."""
    lines = ["| action | mode | algorithm | horizontal velocity noise, m/s |", "|---|---|---|---|"]
    for action, (kind, algorithm) in enumerate(
        (("low mobility", "EKF"), ("high mobility", "UKF (alpha 1, beta 2, kappa 0)"))
    ):
        tuned = (f"{default_modes(radio)[action].sigma_v:.2f} {radio}" for radio in TUNED_RADIOS)
        lines.append(f"| {action} | {kind} | {algorithm} | {', '.join(tuned)} |")
    modes = "\n".join(lines)
    return inspect.cleandoc(docstring).replace("{modes}", modes)
