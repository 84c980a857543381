"""Position errors as the field reports them, beside means: percentiles, shares, protection levels.

Errors are horizontal (the length of x and y) and vertical (the size of z). The distances are those
that 3GPP TS 22.261, Table 7.3.2.2-1, asks of positioning services. A track may be longer than
memory: errors wait in temporary files, 16 bytes an epoch and kind, and are read to make figures.
"""

from tempfile import SpooledTemporaryFile
from typing import Any
from weakref import finalize

import numpy as np

from mmwave_env.localization.protection import (
    RISK,
    exceedance,
    horizontal_level,
    vertical_level,
)
from mmwave_env.numerics.arrays import Array

SHARES = (0.50, 0.67, 0.80, 0.90, 0.95)  # of the epochs, at which errors are compared
DISTANCES_M = (0.2, 1.0, 3.0, 10.0)
_IN_MEMORY = 1 << 20  # bytes; more of them wait on a disk


def horizontal(error: Array) -> Array:
    """Lengths (...,) of errors (..., 3) in x and y, m."""
    lengths: Array = np.hypot(error[..., 0], error[..., 1])
    return lengths


def vertical(error: Array) -> Array:
    """Sizes (...,) of errors (..., 3) in z, m."""
    sizes: Array = np.abs(error[..., 2])
    return sizes


def percentiles(sizes: Array) -> dict[str, float | None]:
    """What so many percent of errors (n,) stay below, m, as :func:`numpy.quantile` interpolates.

    None where that is no number: there are no errors, or too many are no numbers themselves.
    """
    largest = np.where(np.isnan(sizes), np.inf, sizes)
    with np.errstate(invalid="ignore"):  # between two that are infinite
        found = np.quantile(largest, SHARES) if sizes.size else np.full(len(SHARES), np.nan)
    return {
        f"{100.0 * share:.0f}": float(value) if np.isfinite(value) else None
        for share, value in zip(SHARES, found, strict=True)
    }


def within(sizes: Array) -> dict[str, float | None]:
    """The share of errors (n,) up to each of :data:`DISTANCES_M`; None of no errors."""
    return {
        f"{limit:g}": float((sizes <= limit).mean()) if sizes.size else None
        for limit in DISTANCES_M
    }


class BoundedErrors:
    """Errors of one kind, and the protection level of each."""

    def __init__(self) -> None:
        self._file: Any = SpooledTemporaryFile(_IN_MEMORY)  # noqa: SIM115 - open as long as self
        finalize(self, self._file.close)

    def add(self, error_m: Array, level_m: Array) -> None:
        """Take more epochs: errors and levels, of one shape, m."""
        self._file.write(np.stack([error_m.ravel(), level_m.ravel()], axis=1).tobytes())

    def rows(self) -> Array:
        """Errors and levels (n, 2) of all epochs, m."""
        self._file.seek(0)
        found = np.frombuffer(self._file.read()).reshape(-1, 2)
        self._file.seek(0, 2)
        return found

    def figures(self) -> dict[str, Any]:
        """What there is to say about them; see docs/errors.md."""
        error, level = self.rows().T
        return {
            "epochs": len(error),
            "percentiles_m": percentiles(error),
            "within_m": within(error),
            "median_level_m": percentiles(level)["50"],
            **exceedance(error, level),
        }


class PositionErrors:
    """Errors of a track, or of many, with the levels that their covariances promise.

    Args:
        risk: that each level leaves to an error above it.
        planar: whether the height is known: then there is nothing vertical.

    Attributes:
        kinds: "horizontal" and "vertical".
    """

    def __init__(self, risk: float = RISK, planar: bool = False) -> None:
        self.risk = risk
        self.kinds = {"horizontal": BoundedErrors()}
        if not planar:
            self.kinds["vertical"] = BoundedErrors()

    def add(self, error: Array, P: Array) -> None:
        """Take more epochs.

        Args:
            error: (..., 3) estimated minus true position, m.
            P: (..., 6 or more) packed covariances of beliefs, which begin with the position.
        """
        self.kinds["horizontal"].add(horizontal(error), horizontal_level(P, self.risk))
        if "vertical" in self.kinds:
            self.kinds["vertical"].add(vertical(error), vertical_level(P, self.risk))

    def figures(self) -> dict[str, dict[str, Any]]:
        """By kind."""
        return {kind: errors.figures() for kind, errors in self.kinds.items()}
