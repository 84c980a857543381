"""Copies of environments, in the middle of an episode, too; they go on to the last bit."""

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from typing import Any, Self

import numpy as np

from mmwave_env.engines.baseline import Baseline
from mmwave_env.engines.env_engine import Engine
from mmwave_env.task import Task


class Copied:
    """What a single and a vector environment need to be copied by ``deepcopy`` and ``pickle``.

    Compiled code and what refers to it is made anew, all else is copied. A deep copy shares the
    task, which no step changes, and with it the source of episodes.
    """

    _task: Task
    _engine: Engine
    _baseline: Baseline | None
    _begun: bool
    _set_up: Callable[[], None]  # makes what follows from the arguments: it is not copied

    def _set_up_noting(self) -> None:
        """Set up, and note what a copy does not need because it does the same."""
        given = set(vars(self))
        self._set_up()
        self._remade = frozenset(vars(self)) - given

    def __getstate__(self) -> dict[str, Any]:
        """What a copy cannot make anew."""
        kept = {key: value for key, value in vars(self).items() if key not in self._remade}
        return kept | {"tracks": self._engine.batch.state, "keys": self._engine.keys}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on, to the last bit, as the environment did that was copied."""
        vars(self).update(state)
        tracks, keys = vars(self).pop("tracks"), vars(self).pop("keys")
        self._set_up_noting()
        self._engine.keys = keys
        self._engine.go_on(self._task, tracks)
        if self._baseline and self._begun:
            everywhere = np.arange(self._engine.batch.n)
            self._baseline.begin(everywhere, partial(self._engine.episodes, self._task))

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """A copy that goes on by itself."""
        twin = type(self).__new__(type(self))
        memo |= {id(self): twin, id(self._task): self._task}
        twin.__setstate__(deepcopy(self.__getstate__(), memo))
        return twin
