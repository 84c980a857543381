"""Errors and NEES of contenders in every epoch, for pictures."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import EpochResults
from mmwave_env.metrics import scored
from mmwave_env.numerics.numbers import Array


@dataclass
class EpochErrors:
    """Errors and NEES of contenders in all scored epochs of episodes of one length."""

    names: Mapping[str, str]  # name in figures, by contender; other contenders are skipped
    time_s: Array = field(default_factory=lambda: np.zeros(0))  # (T,) times since the first epoch
    _errors: dict[str, list[Array]] = field(default_factory=dict)
    _nees: dict[str, list[Array]] = field(default_factory=dict)

    def add(self, contender: Contender, time_s: Array, told: EpochResults) -> None:
        """Add the epoch results of a contender on some episodes with epochs at times (T,)."""
        if contender.name in self.names:
            name, counts = self.names[contender.name], scored(len(time_s))
            self.time_s = (time_s - time_s[0])[counts]
            self._errors.setdefault(name, []).append(told["error"][:, counts].astype(np.float32))
            self._nees.setdefault(name, []).append(told["nees"][:, counts])

    @property
    def errors_m(self) -> dict[str, Array]:
        """Return position errors (n, T, 3) by name, m."""
        return {name: np.concatenate(parts) for name, parts in self._errors.items()}

    @property
    def nees(self) -> dict[str, Array]:
        """Return NEES (n, T) by name."""
        return {name: np.concatenate(parts) for name, parts in self._nees.items()}
