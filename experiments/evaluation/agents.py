"""Agents from your own code: functions from observations to actions, checked before they run."""

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import CORRECTION, WEIGHTS, limits_of, numbers_in
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import OF_A_MODEL, Correction, Policy
from mmwave_env.models.measurement import Epoch, Site, blank_site
from mmwave_env.numerics.numbers import Array, Array32, Index, Mask, Vector
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import EpisodeBatch, blank_incoming

Act = Callable[[Array32], Any]  # observations (n, features) -> actions (n,)

MODULE = re.compile(r"[\w.]+:[\w.]+")
GUIDE = "docs/own-agent.md"
EXPECTED = "module:function, a function that takes no arguments and returns the agent"
NO_FILTERS = "which runs no filters and works only in comparisons; expected another policy"
CORRECTION_LIMITS = np.append(limits_of(CORRECTION, 0), 1.0)  # of shift, log factor and trust
TRIED = 3  # number of random observations to try an agent on


class Estimator(Policy):
    """An agent that tracks users itself, without the filters; it works only in comparisons.

    Attributes:
        at_once: whether one call of :meth:`track` handles all n episodes, with arrays (n,) in
            place of floats; otherwise each call handles one episode.
    """

    at_once = False

    def track(
        self, pipeline: Pipeline, site: Site, epochs: Iterator[Epoch]
    ) -> Iterable[tuple[Vector, Vector]]:
        """Yield a mean (7,) and a packed covariance (28,) after every epoch.

        A mean is [px, py, pz, vx, vy, vz, Doppler bias], in m, m/s and Hz; a packed covariance is
        the lower triangle, row by row. If the clock offset is unknown, it is the mean's eighth
        component, and the shapes are (8,) and (36,). The pipeline has the radio's default modes.
        """
        raise NotImplementedError

    def estimate(self, pipeline: Pipeline, episodes: EpisodeBatch) -> tuple[Array, Array]:
        """Return means (n, T, 7) and packed covariances (n, T, 28) of n episodes.

        Raises:
            ValueError: a belief has a wrong shape, or an epoch has no belief.
        """
        layout = pipeline.layout
        n, T, _ = episodes.table.shape
        size = layout.state_size
        blank = blank_incoming(layout)
        tracks = []
        for some in [slice(None)] if self.at_once else range(n):
            site = unflatten(blank_site(layout), iter(episodes.site[some].T))
            rows = np.moveaxis(episodes.table[some], -2, 0)
            first = unflatten(blank, iter(rows[0].T))
            site = site._replace(prior_x=pipeline.prior(site.prior_x, first.truth))
            epochs = (unflatten(blank, iter(row.T)).epoch(layout) for row in rows)
            beliefs = [[*x, *P] for x, P in self.track(pipeline, site, epochs)]
            shape = len(beliefs), len(min(beliefs, key=len, default=()))
            if shape != (T, size + layout.triangle):
                raise ValueError(
                    f"beliefs of {type(self).__name__}: found {shape[0]} beliefs of {shape[1]} "
                    f"numbers, expected {T} of {size} (mean) + {layout.triangle} (covariance)"
                )
            full = np.array([np.broadcast_arrays(site.hz_per_mps, *row)[1:] for row in beliefs])
            tracks.append(np.moveaxis(np.atleast_3d(full), -1, 0))
        made = np.concatenate(tracks)
        return made[..., :size], made[..., size:]

    def act(self, observation: Array32) -> Index:
        """Refuse to choose a mode."""
        raise ValueError(f"policy: found {type(self).__name__}, {NO_FILTERS}")


@contextmanager
def blaming(name: str, more: str) -> Iterator[None]:
    """Turn an exception of a user's code into a ValueError that names the policy, and ``more``."""
    try:
        yield
    except Exception as error:  # a user's code can raise anything
        raise ValueError(
            f"policy {name}: {type(error).__name__}: {str(error).partition(chr(10))[0]}{more}"
        ) from error


def is_agent(name: str) -> bool:
    """Return whether a name has the form module:function."""
    return MODULE.fullmatch(name) is not None


def agent_from(name: str) -> Act:
    """Return the agent that ``module:function`` makes; the function takes no arguments.

    The module is on ``sys.path`` or in the current folder.

    Raises:
        ValueError: the agent can't be made; the message says why.
    """
    with blaming(name, f"; expected {EXPECTED} ({GUIDE})"):
        return cast(Act, _resolved(name)())


def _resolved(name: str) -> Any:
    """Return what ``module:function`` names, or the module that ``module:`` names."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last, so that installed modules take precedence
    return resolve_name(name)


def module_file(name: str) -> Path:
    """Return the file of the module in ``module:function``.

    Raises:
        ValueError: there is no such module.
    """
    with blaming(name, f"; expected {EXPECTED} ({GUIDE})"):
        return Path(str(_resolved(f"{name.partition(':')[0]}:").__file__))


class Checked(Policy):
    """An agent's policy, whose answers are checked in every epoch.

    It is first tried on a few random observations. Errors name the agent and the epoch.

    Raises:
        ValueError: the agent raises an exception, or returns invalid actions.
    """

    def __init__(self, name: str, policy: Policy, table: Observation) -> None:
        self.action = policy.action
        self._name = name
        self._policy = policy
        self._table = table
        space = table.space
        rng = np.random.default_rng(0)
        shown = rng.uniform(space.low, space.high, (TRIED, len(table))).astype(np.float32)
        self.reset(np.ones(TRIED, np.bool_))
        self.act(shown)

    def reset(self, mask: Mask) -> None:
        """Tell the agent that episodes begin where ``mask`` (n,) is True."""
        self._epoch = 0
        with blaming(self._name, f"; it was told that episodes begin ({GUIDE})"):
            self._policy.reset(mask)

    def act(self, observation: Array32) -> NDArray[Any]:
        """Return the agent's actions (n,), or weights (n, modes)."""
        self._epoch += 1
        n = len(observation)
        count = len(self._table.actions)
        circumstances = (
            f"; it was given observations {observation.shape}, float32, of epoch {self._epoch}, "
            f"made with {self._table.made_with}; {OF_A_MODEL} ({GUIDE})"
        )
        with blaming(self._name, circumstances):
            actions = np.asarray(self._policy.act(observation))
        if self.action == WEIGHTS:
            with blaming(self._name, f" ({GUIDE})"):
                return numbers_in("weights", actions, limits_of(WEIGHTS, count - 1), n)
        if actions.shape != (n,) or actions.dtype.kind not in "iu":
            raise ValueError(
                f"actions of {self._name}: found shape {actions.shape} of {actions.dtype}, "
                f"expected ({n},) of integers, one for each row of the observations; "
                f"{OF_A_MODEL}; an agent that returns weights has the attribute "
                f'action = "weights" ({GUIDE})'
            )
        if actions.min() < 0 or actions.max() >= count:
            raise ValueError(
                f"actions of {self._name}: found {actions.min()} (smallest) and {actions.max()} "
                f"(largest), expected 0 to {count - 1}"
            )
        return actions.astype(np.int64)

    def correct(self, observation: Array32) -> Correction | None:
        """Return the agent's corrections, if it has any."""
        with blaming(self._name, f", in epoch {self._epoch} ({GUIDE})"):
            made: Any = self._policy.correct(observation)
            columns = np.column_stack([made.shift, made.log_factor, made.trusted])
            numbers_in(
                "shift, log_factor and trusted", columns, CORRECTION_LIMITS, len(observation)
            )
            return made  # type: ignore[no-any-return]
