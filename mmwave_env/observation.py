"""The observation: one table of features that makes the space, the docs and the values.

Every feature is something an estimator knows at run time; none sees the truth. The values
are functions of numbers, so they are computed inside the SIMD kernel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from typing import NamedTuple, TypeVar

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mmwave_env.arithmetic import Matrix, Number, Vector, clip, log, sqrt, where
from mmwave_env.estimator.algebra import dot
from mmwave_env.estimator.motion import move
from mmwave_env.estimator.pipeline import Candidate, Epoch, Memory, Pipeline, Site

Index = TypeVar("Index")

OBSERVATIONS = {"full": "everything", "prior": "nothing of how each mode sees the coming epoch"}


class View(NamedTuple):
    """What a feature may look at.

    Attributes:
        x, P: (7,), (7, 7) belief after the last epoch.
        memory: of the track.
        candidates: per mode, what it would make of the coming epoch.
        epoch: the coming epoch.
        site: anchors and carrier.
    """

    x: Vector
    P: Matrix
    memory: Memory
    candidates: list[Candidate]
    epoch: Epoch
    site: Site


@dataclass(frozen=True)
class Feature:
    """One component of the observation: clip(value / scale, low, high).

    Attributes:
        name: unique in the table.
        meaning: what it is, with the formula where the name does not say it.
        unit: of the value.
        scale: what one unit of the observation stands for.
        low, high: bounds of the observation.
        value: the formula.
    """

    name: str
    meaning: str
    unit: str
    scale: float
    low: float
    high: float
    value: Callable[[View], Number]


class Observation:
    """The table of features of an environment, in order.

    Attributes:
        features: the table.
        kind: "full" or "prior".
        modes: of the pipeline that the features describe.
    """

    def __init__(self, pipeline: Pipeline, kind: str = "full") -> None:
        if kind not in OBSERVATIONS:
            raise ValueError(f"observation: found {kind!r}, expected one of {list(OBSERVATIONS)}")
        self.kind, self.modes = kind, pipeline.modes
        coming = _coming(pipeline) if kind == "full" else []
        self.features = [*_context(pipeline), *coming]
        self._index = {feature.name: i for i, feature in enumerate(self.features)}

    def __len__(self) -> int:
        return len(self.features)

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


def _at(function: Callable[[View, Index], Number], index: Index) -> Callable[[View], Number]:
    """The formula of one anchor, group or mode."""
    return lambda view: function(view, index)


def _speed(view: View) -> Number:
    v = view.x[3:6]
    return sqrt(dot(v, v))


def _log_trace(first: int) -> Callable[[View], Number]:
    return lambda view: log(view.P[first][first] + view.P[first + 1][first + 1] + 1e-12)


def _mean_nis(layout_rows: list[float], candidate: Candidate, epoch: Epoch) -> Number:
    rows = dot(epoch.visible, layout_rows)
    total = dot(epoch.visible, candidate.nis)
    return total / where(rows > 0.5, rows, 1.0)


def _along(view: View, candidate: Candidate, across: bool) -> Number:
    """Candidate correction of the position along the predicted velocity, or to its left."""
    predicted = move(view.x, view.epoch.dt)
    step = [candidate.x[i] - predicted[i] for i in range(2)]
    v = predicted[3:5]
    speed = sqrt(v[0] * v[0] + v[1] * v[1] + 1e-6)
    product = step[1] * v[0] - step[0] * v[1] if across else dot(step, v)
    return product / speed


def _context(pipeline: Pipeline) -> list[Feature]:
    layout = pipeline.layout
    table = [
        Feature("predicted speed", "norm of the predicted velocity", "m/s", 10, 0, 5, _speed),
        Feature(
            "Doppler spread", "of the coming epoch, over f_c / c", "m/s", 10, 0, 5,
            lambda v: v.epoch.doppler_spread_hz / v.site.hz_per_mps,
        ),
    ]  # fmt: skip
    if layout.odometry:
        table.append(
            Feature(
                "odometry speed", "of the coming epoch; predicted speed where missing", "m/s", 10,
                0, 5,
                lambda v: where(
                    v.epoch.visible[-1] > 0.5, v.epoch.z[layout.doppler + 1], _speed(v)
                ),
            )
        )  # fmt: skip
    for g, name in enumerate(layout.group_names):
        table.append(
            Feature(
                f"NIS {name}", "ln(1 + NIS) of the last epoch", "", 1, 0, 10,
                _at(lambda v, g: log(1.0 + v.memory.nis[g]), g),
            )
        )  # fmt: skip
    for g, name in enumerate(layout.group_names):
        table.append(
            Feature(
                f"verdict {name}", "last epoch: 1 accepted, -1 gated, 0 missing", "", 1, -1, 1,
                _at(lambda v, g: v.memory.accepted[g] - v.memory.rejected[g], g),
            )
        )  # fmt: skip
    table += [
        Feature(
            "position variance", "ln of the trace of P, horizontal position", "ln m^2", 5, -4, 4,
            _log_trace(0),
        ),
        Feature(
            "velocity variance", "ln of the trace of P, horizontal velocity", "ln (m/s)^2", 5, -4,
            4, _log_trace(3),
        ),
    ]  # fmt: skip
    for a in range(layout.anchors):
        table.append(
            Feature(
                f"SNR anchor {a + 1}", "of the coming epoch; -20 dB where missing", "dB", 20, -1,
                4,
                _at(lambda v, a: where(v.epoch.visible[a] > 0.5, v.epoch.snr_db[a], -20.0), a),
            )
        )  # fmt: skip
    for m, mode in enumerate(pipeline.modes):
        table.append(
            Feature(
                f"previous mode {mode.name}", "1 if it ran in the last epoch", "", 1, 0, 1,
                _at(lambda v, m: where(abs(v.memory.mode - float(m)) < 0.5, 1.0, 0.0), m),
            )
        )  # fmt: skip
    for i, pace in enumerate(("fast", "slow")):
        table.append(
            Feature(
                f"NIS {pace} average", "of NIS / dof of what was accepted", "", 1, 0, 10,
                _at(lambda v, i: v.memory.nis_average[i], i),
            )
        )  # fmt: skip
    for i, way in enumerate(("along", "across")):
        table.append(
            Feature(
                f"correction {way}", f"average position correction {way} the velocity", "m", 1,
                -10, 10, _at(lambda v, i: v.memory.correction[i], i),
            )
        )  # fmt: skip
    table += [
        Feature("gamma", "adaptive scale of Q and R", "", 1, 0.5, 2, lambda v: v.memory.gamma),
        Feature(
            "lock-out", "epochs in a row with no visible link within its gate", "epochs", 1, 0, 10,
            lambda v: v.memory.lockout,
        ),
        Feature(
            "time since fix", "since a link was last accepted", "s", 10, 0, 5,
            lambda v: v.memory.unfixed_s,
        ),
    ]  # fmt: skip
    return table


def _coming(pipeline: Pipeline) -> list[Feature]:
    layout = pipeline.layout
    rows = [float(r.stop - r.start) for r in layout.groups]
    links = [1.0] * layout.anchors
    last = pipeline.modes[-1].name
    table = []
    for m, mode in enumerate(pipeline.modes):
        name = mode.name
        table += [
            Feature(
                f"coming NIS {name}", "ln(1 + NIS / dof) over the visible groups", "", 1, 0, 10,
                _at(lambda v, m: log(1.0 + _mean_nis(rows, v.candidates[m], v.epoch)), m),
            ),
            Feature(
                f"coming rejected {name}", "links it would reject", "links", 1, 0,
                layout.anchors,
                _at(
                    lambda v, m: dot(links, v.epoch.visible)
                    - dot(links, v.candidates[m].accepted),
                    m,
                ),
            ),
            Feature(
                f"coming correction along {name}", "of its position, along the velocity", "m", 1,
                -10, 10, _at(lambda v, m: _along(v, v.candidates[m], across=False), m),
            ),
            Feature(
                f"coming correction across {name}", "of its position, to the left", "m", 1,
                -10, 10, _at(lambda v, m: _along(v, v.candidates[m], across=True), m),
            ),
        ]  # fmt: skip
        if m == len(pipeline.modes) - 1:
            continue
        table.append(
            Feature(
                f"coming log-likelihood {name}", f"minus that of {last}", "nats", 5, -6, 6,
                _at(
                    lambda v, m: v.candidates[m].log_likelihood
                    - v.candidates[-1].log_likelihood,
                    m,
                ),
            )
        )  # fmt: skip
        for i, pace in enumerate(("fast", "slow")):
            table.append(
                Feature(
                    f"preference {pace} {name}",
                    f"{pace} average of its log-likelihood minus that of {last}", "nats", 5, -6,
                    6, _at(lambda v, at: v.memory.preference[at[0]][at[1]], (i, m)),
                )
            )  # fmt: skip
    return table
