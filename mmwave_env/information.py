"""What environments tell: the info of a step, for many at once, and that of a whole episode."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.engine import Engine
from mmwave_env.estimator.smoother import smooth
from mmwave_env.metrics import accuracy, ate, scored

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STEP_KEYS = ("position_error_m", "nees", "nis", "accepted", "rejected", "mode", "gamma")
METRICS = {
    "ate_m": "ate_m", "rmse_m": "rmse_m", "rpe_m": "rpe_m", "nees": "mean_nees",
    "in_bounds": "in_bounds", "divergence_rate": "divergence",
}  # fmt: skip


class Panel:
    """What observations, rewards and infos of the environments in an engine are made of.

    Args:
        engine: the environments.
    """

    def __init__(self, engine: Engine) -> None:
        self._read, at = engine.read, engine.at
        memory, span = at.memory, engine.span
        self._reward, self._distance, self._nees = at.reward, at.distance, at.nees
        self._mode, self._gamma = memory.mode, memory.gamma
        self._observation, self._nis = span(at.observation), span(memory.nis)
        self._accepted, self._rejected = span(memory.accepted), span(memory.rejected)
        self._truth, self._estimate = span(at.truth), span(at.x)

    def observations(self) -> NDArray[np.float32]:
        """(n, features), what the agents see."""
        return self._read(self._observation, np.float32)

    def rewards(self) -> Array:
        """(n,) of the last step, as the reward function has them."""
        return self._read(self._reward)

    def step_info(self) -> dict[str, NDArray[Any]]:
        """What the last step did."""
        read = self._read
        return {
            "position_error_m": read(self._distance),
            "nees": read(self._nees),
            "nis": read(self._nis),
            "accepted": read(self._accepted) > 0.5,
            "rejected": read(self._rejected) > 0.5,
            "mode": read(self._mode, np.int64),
            "gamma": read(self._gamma),
        }

    def state_info(self) -> dict[str, NDArray[Any]]:
        """Where the users are, and where they are believed to be."""
        return {"truth": self._read(self._truth), "estimate": self._read(self._estimate)}


def masked(values: dict[str, NDArray[Any]], where: Mask) -> dict[str, Any]:
    """Infos (n, ...) of the environments in ``where`` (n,), as Gymnasium batches them.

    The arrays are taken over; elsewhere they become 0, or None. Every key has a mask ``_key``.
    There are no keys where there is no environment.
    """
    count = np.count_nonzero(where)
    if count == 0:
        return {}
    if count < len(where):
        elsewhere = ~where
        for array in values.values():
            array[elsewhere] = None if array.dtype == object else 0
    return values | {f"_{key}": where.copy() for key in values}


def episode_info(
    error: Array, nees: Array, x: Array, P: Array, P_predicted: Array, dt: Array, planar: bool
) -> dict[str, Array]:
    """Metrics (n,) of n tracks of T epochs, and what smoothing would make of them.

    Every track gets the same numbers, to the last bit, whatever tracks are beside it.

    Args:
        error: (n, T, 3) estimated minus true position, m.
        nees: (n, T).
        x, P, P_predicted: (n, T, 7), (n, T, 28), (n, T, 28) as in
            :func:`~mmwave_env.estimator.smoother.smooth`.
        dt: (n, T - 1) seconds between epochs.
        planar: z and vz are known exactly.
    """
    error, nees = np.ascontiguousarray(error), np.ascontiguousarray(nees)
    n, epochs = nees.shape
    rate = 1.0 / np.median(dt, axis=-1) if epochs > 1 else np.ones(n)
    second = np.maximum(1, np.round(rate))
    found = {name: np.empty(n) for name in METRICS.values()}
    for alike in np.unique(second):  # epochs in a second; usually all tracks have as many
        some = second == alike
        metrics = accuracy(error[some], nees[some], alike, 2 if planar else 3)
        for name, values in metrics.items():
            found[METRICS[name]][some] = values
    smoothed, _ = smooth(x, P, P_predicted, dt, planar)
    better = smoothed[..., :3] - x[..., :3] + error
    return {**found, "smoothed_ate_m": ate(better[:, scored(epochs)])}
