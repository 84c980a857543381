"""Protection levels of position errors: Gaussian levels times factors that a network learned.

A protection level is a bound that an error exceeds with a stated probability, the risk. Errors
exceed Gaussian levels (:mod:`mmwave_env.localization.position_errors`) with this probability only
if the covariance is right. As it may be wrong, each Gaussian level is multiplied by a factor. A
network, trained by quantile regression, computes the factor's logarithm from features of a filter's
state. A constant, which depends on the kind of filter, the risk and the direction (horizontal or
vertical), is added to this logarithm. The constants were computed by split conformal prediction on
episodes that the training did not use (Y. Romano, R. Patterson and E. Candès, "Conformalized
quantile regression", NeurIPS 2019; for epochs grouped in episodes: Y. Lee, R. F. Barber and R.
Willett, "Distribution-free inference with hierarchical data", 2023). docs/errors.md says what these
levels guarantee; the network is trained by experiments/training/levels.py.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors import safe_open
from safetensors.numpy import save

from mmwave_env.io.files import DATA
from mmwave_env.io.lookup import choose
from mmwave_env.localization.position_errors import error_sizes, gaussian_levels, horizontal
from mmwave_env.metrics import RISK
from mmwave_env.numerics.numbers import Array

# parts of a filter's state from which the network's inputs, the features, are computed
PARTS = ("x", "P", "memory.nis", "memory.accepted", "memory.rejected")
CALIBRATED = "calibrated"
GAUSSIAN = "gaussian"
_MEMORY = np.array([[0.6], [0.9], [0.97]])  # in running means: weight of the past after 1 s
# lower limits, so that logarithms and quotients are finite
_LEAST = 1e-9
_LEAST_S = 1e-2
_LARGEST_RISK = 0.5
_KIND = [18, 20]  # indices of two 0/1 features: presence of a corrector and of a bank of modes


class Network(NamedTuple):
    """A network with its calibration.

    Attributes:
        risks: (R,) risks for which the network was trained and calibrated.
        tensors: arrays by their names in the file: ``low`` and ``high`` (features,), the limits to
            which features are clipped, as in the training; ``layer.0.weight`` (outputs, inputs),
            ``layer.0.bias`` (outputs,), and so on; and ``constants`` (3, R, 2), numbers that the
            calibration adds to the network's outputs, by kind of filter (one mode, bank of modes,
            bank with a corrector of its beliefs), by risk, and by direction (horizontal, vertical).
    """

    risks: list[float]
    tensors: dict[str, Array]

    @classmethod
    def read(cls, path: Path) -> "Network":
        """Read the network in a file that :meth:`to_bytes` filled."""
        with safe_open(path, "np") as file:
            risks = json.loads(file.metadata()["levels"])["risks"]
            tensors = {name: file.get_tensor(name).astype(float) for name in file.keys()}  # noqa: SIM118
        return cls(risks, tensors)

    def to_bytes(self, command: str) -> bytes:
        """Return the content of a ``.safetensors`` file; ``command`` made the network."""
        tensors = dict[str, Any]()
        for name, tensor in self.tensors.items():
            precision = np.float64 if name == "constants" else np.float32
            tensors[name] = np.ascontiguousarray(tensor, precision)
        card = {"command": command, "risks": self.risks}
        written: bytes = save(tensors, {"levels": json.dumps(card)})
        return written

    def log_factors(self, features: Array) -> Array:
        """Return logarithms of factors (..., R, 2), given features (..., features)."""
        of = self.tensors
        values = np.fmin(np.fmax(features, of["low"]), of["high"])  # NaN becomes the low limit
        for i in range(sum(name.endswith("weight") for name in of)):
            hidden = np.tanh(values) if i else values
            values = _weighted(hidden, of[f"layer.{i}.weight"]) + of[f"layer.{i}.bias"]
        kinds = features[..., _KIND].sum(axis=-1).astype(int)
        return values.reshape(*values.shape[:-1], -1, 2) + of["constants"][kinds]  # type: ignore[no-any-return]


def _weighted(values: Array, weight: Array) -> Array:
    """Return the products (..., k) of vectors (..., m) and a matrix (k, m).

    Unlike ``@``, the result of a vector does not depend, to the bit, on the others beside it.
    """
    return np.einsum("...m,km->...k", values, weight)  # type: ignore[no-any-return]


@cache
def shipped() -> Network:
    """Return the network that is shipped with the package."""
    return Network.read(DATA / "levels.safetensors")


class Levels:
    """Protection levels of tracks that are filtered side by side.

    Args:
        risk: probability that an error exceeds its level.
        kind: "calibrated", or "gaussian" for levels computed from covariances alone.

    Raises:
        ValueError: the kind or the risk is invalid, or no levels were calibrated for this risk.

    Attributes:
        memory: arrays that keep the past of the n current tracks: running means with three weights
            (n, 3, quantities), states after the last epoch (n, 1, 7 or 8), and times (n,) of the
            first and of the last epoch; empty where tracks begin.
    """

    def __init__(self, risk: float = RISK, kind: str = CALIBRATED) -> None:
        if not 0.0 < risk <= _LARGEST_RISK:
            raise ValueError(f"risk: found {risk:g}, expected above 0 and at most {_LARGEST_RISK}")
        choose(dict.fromkeys([CALIBRATED, GAUSSIAN]), kind, "levels")
        self.risk = risk
        self.kind = kind
        if kind == CALIBRATED and risk not in shipped().risks:
            covered = " or ".join(f"{known:g}" for known in shipped().risks)
            raise ValueError(
                f"risk: found {risk:g}, expected {covered}, which the calibrated levels cover; "
                "--levels gaussian takes any risk"
            )
        self.reset()

    def reset(self) -> None:
        """Forget the current tracks; the next epoch begins new tracks."""
        self.memory: Sequence[Array] = ()

    def factors(
        self, anchors: int, mixes: bool, time_s: Array, results: Mapping[str, Any]
    ) -> Array:
        """Return factors (n, T, 2) of Gaussian levels; :meth:`features` describes the arguments."""
        if self.kind == GAUSSIAN:
            return np.ones((*results["x"].shape[:2], 2))
        logs = shipped().log_factors(self.features(anchors, mixes, time_s, results))
        return np.exp(logs[..., shipped().risks.index(self.risk), :])  # type: ignore[no-any-return]

    def features(
        self, anchors: int, mixes: bool, time_s: Array, results: Mapping[str, Any]
    ) -> Array:
        """Return the features (n, T, features) of the next T epochs of n tracks.

        Args:
            anchors: number of anchors.
            mixes: whether the beliefs come from a bank of interacting modes.
            time_s: (T,) or (n, T) times of the epochs.
            results: the :data:`PARTS` by name: means x (n, T, 7 or 8); packed covariances P (n, T,
                28 or 36); NIS, acceptance and rejection (0 or 1) of each group of measurements, as
                three arrays (n, T, groups); optionally "trusted", factors (n, T) that scaled
                corrections; NaN if not corrected.
        """
        x, P, nis, accepted, rejected = [results[part] for part in PARTS]
        trusted = results.get("trusted")
        time_s = np.broadcast_to(time_s, x.shape[:2])
        begins = time_s[:, 0]
        mean, last_x, first_s, last_s = self.memory or (np.empty(0), x[:, :1], begins, begins)
        dt = np.diff(time_s, prepend=last_s[:, None])
        past = np.append(last_x, x[:, :-1], axis=1)
        moved = x[..., :3] - past[..., :3] - dt[..., None] * past[..., 3:6]
        sizes = _sizes(P)
        gates = _gates(anchors, nis, accepted, rejected)
        now = np.concatenate([gates, sizes, _relative(moved, sizes)], axis=-1)
        averaged = np.concatenate([now, moved, x[..., 3:5]], axis=-1)
        if not self.memory:
            mean = np.repeat(averaged[:, 0, None], len(_MEMORY), axis=1)
        means = np.empty((*now.shape[:2], *mean.shape[1:]))
        for t, keep in enumerate(_MEMORY ** dt.T[..., None, None]):
            means[:, t] = mean = keep * mean + (1.0 - keep) * averaged[:, t, None]
        self.memory = mean, x[:, -1:], first_s, time_s[:, -1]
        lag = np.moveaxis(_relative(means[..., -5:-2], sizes[..., None, :]), -1, 0)
        turn = np.log1p(horizontal(means[..., -2:] - x[..., None, 3:5]))
        clocks = np.log(np.maximum(dt, _LEAST_S)), np.log1p(time_s - first_s[:, None])
        known = np.full(now.shape[:2], np.nan) if trusted is None else trusted
        corrected = np.isfinite(known)
        rest = [*_shape(x, P), *clocks, corrected, np.where(corrected, known, 1.0), float(mixes)]
        alone = np.stack(np.broadcast_arrays(*rest), axis=-1)
        steady = means[..., :-5].reshape(*now.shape[:2], -1)
        return np.concatenate([now, alone, steady, *lag, turn], axis=-1)


GAUSSIAN_LEVELS = Levels(kind=GAUSSIAN)  # of the default risk; they have no memory


def _gates(anchors: int, nis: Any, accepted: Any, rejected: Any) -> Array:
    """Return features (n, T, 8) of innovations and gates, whatever the number of anchors."""
    measured = accepted + rejected
    links = measured[..., :anchors].sum(axis=-1)
    nis = nis * measured
    features = [
        np.log1p(nis[..., :anchors].max(axis=-1)),
        np.log1p(nis[..., :anchors].sum(axis=-1) / np.maximum(links, 1.0)),
        rejected[..., :anchors].mean(axis=-1),
        1.0 - links / anchors,
        accepted[..., :anchors].sum(axis=-1) < 0.5,
        np.log1p(nis[..., anchors]),
        rejected[..., anchors],
        1.0 - measured[..., anchors],
    ]
    return np.stack(features, axis=-1)


def _sizes(P: Array) -> Array:
    """Return the logarithms (n, T, 2) of the horizontal and of the vertical Gaussian level.

    If the height is known exactly, the horizontal level is returned instead of the vertical one.
    """
    levels = gaussian_levels(P, RISK)
    levels[..., 1] = np.where(P[..., 5] > 0.0, levels[..., 1], levels[..., 0])
    return np.log(np.maximum(levels, _LEAST))  # type: ignore[no-any-return]


def _relative(moved: Array, sizes: Array) -> Array:
    """Return log(1 + 10 length / level) in x-y and in z, (..., 2), given log(level) (..., 2).

    The vectors are (..., 3).
    """
    return np.log1p(10.0 * error_sizes(moved) * np.exp(-sizes))  # type: ignore[no-any-return]


def _shape(x: Array, P: Array) -> list[Array]:
    """Return four features (n, T) of the position's error ellipse and of the velocity."""
    xx, xy, yy = np.moveaxis(P[..., :3], -1, 0)
    vx, vy = np.moveaxis(x[..., 3:5], -1, 0)
    mean = np.maximum(0.5 * (xx + yy), _LEAST)
    square = vx * vx + vy * vy
    along = vx * vx * xx + 2.0 * vx * vy * xy + vy * vy * yy
    return [
        np.log(np.sqrt(np.maximum(xx * yy - xy * xy, _LEAST**2)) / mean),
        np.log(np.maximum(along / (mean * np.maximum(square, 1e-2)), 1e-2)),
        0.5 * np.log(np.maximum(P[..., 9] + P[..., 14], _LEAST)),
        np.log1p(np.sqrt(square)),
    ]
