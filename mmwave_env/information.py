"""What environments tell: the info of a step, for many at once, and that of a whole episode."""

from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.engine import Engine
from mmwave_env.estimator.program import rows_of
from mmwave_env.estimator.trees import leaves
from mmwave_env.metrics import accuracy, ate, scored

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

STEP_KEYS = ("position_error_m", "nees", "nis", "accepted", "rejected", "mode", "gamma")
METRICS = {
    "ate_m": "ate_m", "rmse_m": "rmse_m", "rpe_m": "rpe_m", "nees": "mean_nees",
    "in_bounds": "in_bounds", "divergence_rate": "divergence",
}  # fmt: skip


class Panel:
    """What a step tells of the environments in an engine.

    Args:
        engine: the environments.

    Attributes:
        rows: numbers of the rows that :meth:`~mmwave_env.engine.Engine.step` has to tell.
    """

    def __init__(self, engine: Engine) -> None:
        at, memory = engine.at, engine.at.memory
        tree = {
            "reward": at.reward, "position_error_m": at.distance, "nees": at.nees,
            "gamma": memory.gamma, "nis": memory.nis, "truth": at.truth, "estimate": at.x,
            "verdicts": [memory.accepted, memory.rejected],
        }  # fmt: skip
        self.rows = rows_of(list(tree.values()))
        self._columns: dict[str, Any] = {}
        first = 0
        for name, part in tree.items():
            end = first + len(leaves(part))
            self._columns[name] = first if isinstance(part, int) else slice(first, end)
            first = end
        self._groups = len(memory.accepted)
        self._read, self._truth, self._estimate = engine.read, at.truth, at.x

    def rewards(self, told: Array) -> Array:
        """(n,) of the step, as the reward function has them."""
        return told[:, self._columns["reward"]].copy()

    def step_info(self, told: Array, actions: Index) -> dict[str, NDArray[Any]]:
        """What the step did with the modes (n,), which are taken over."""
        columns, groups = self._columns, self._groups
        verdicts = told[:, columns["verdicts"]].astype(np.bool_)
        return {
            "position_error_m": told[:, columns["position_error_m"]],
            "nees": told[:, columns["nees"]],
            "nis": told[:, columns["nis"]],
            "accepted": verdicts[:, :groups],
            "rejected": verdicts[:, groups:],
            "mode": actions,
            "gamma": told[:, columns["gamma"]],
        }

    def state_info(self, told: Array) -> dict[str, NDArray[Any]]:
        """Where the users are, and where they are believed to be."""
        return {
            "truth": told[:, self._columns["truth"]],
            "estimate": told[:, self._columns["estimate"]],
        }

    def state_now(self) -> dict[str, NDArray[Any]]:
        """The same, whenever asked for."""
        return {"truth": self._read(self._truth), "estimate": self._read(self._estimate)}


def masked(values: dict[str, NDArray[Any]], where: Mask | None = None) -> dict[str, Any]:
    """Infos (n, ...) of the environments in ``where`` (n,), as Gymnasium batches them.

    The arrays are taken over; elsewhere they become 0, or None. Every key has a mask ``_key``.
    There are no keys where there is no environment. None means all. The masks are one array: new
    ones for every key would cost few environments a twentieth of their step.
    """
    if where is not None:
        if not where.any():
            return {}
        elsewhere = ~where
        for array in values.values():
            array[elsewhere] = None if array.dtype == object else 0
    keys = tuple(values)
    mask = (_everywhere(len(values[keys[0]])) if where is None else where).copy()
    return {**values, **dict.fromkeys(_mask_keys(keys), mask)}


@cache
def _mask_keys(keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"_{key}" for key in keys)


@lru_cache(maxsize=8)
def _everywhere(n: int) -> Mask:
    return np.ones(n, np.bool_)


def episode_info(
    error: Array, nees: Array, smoothed: Array, dt: Array, planar: bool
) -> dict[str, Array]:
    """Metrics (n,) of n tracks of T epochs.

    Every track gets the same numbers, to the last bit, whatever tracks are beside it.

    Args:
        error: (n, T, 3) estimated minus true position, m.
        nees: (n, T).
        smoothed: (n, T, 3) errors of the smoothed track, m.
        dt: (n, T - 1) seconds between epochs.
        planar: z and vz are known exactly.
    """
    n, epochs = nees.shape
    rate = 1.0 / np.median(dt, axis=-1) if epochs > 1 else np.ones(n)
    second = np.maximum(1, np.round(rate))
    found = {name: np.empty(n) for name in METRICS.values()}
    seconds = set(second.tolist())  # epochs in one; usually all tracks have as many
    for alike in seconds:
        some = slice(None) if len(seconds) == 1 else second == alike
        metrics = accuracy(error[some], nees[some], alike, 2 if planar else 3)
        for name, values in metrics.items():
            found[METRICS[name]][some] = values
    return {**found, "smoothed_ate_m": ate(smoothed[:, scored(epochs)])}
