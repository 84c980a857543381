"""A user's own agents: functions from observations to actions, checked before episodes run."""

import importlib
import os
import re
import sys
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import Observation
from mmwave_env.models.layout import Layout
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import EpisodeBatch
from policies import Policy

Act = Callable[[NDArray[np.float32]], Any]  # observations (n, features) -> actions (n,)

MODULE = re.compile(r"[\w.]+:[\w.]+")
GUIDE = "docs/own-agent.md"
OF_A_MODEL = "for a model, use lambda seen: model.predict(seen, deterministic=True)[0]"
TRIED = 3  # number of random observations to try an agent on


class Estimator(Policy):
    """An agent that tracks users by itself instead of choosing filters; it is for comparisons."""

    def estimate(self, pipeline: Pipeline, episodes: EpisodeBatch) -> tuple[Array, Array]:
        """Return means (n, T, 7) and packed covariances (n, T, 28) after every epoch.

        With a clock they are (n, T, 8) and (n, T, 36). The truth in the episodes is off limits.

        Args:
            pipeline: the radio's default modes, layout and terrain.
            episodes: n episodes of T epochs.
        """
        raise NotImplementedError

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.int64]:
        """Refuse to choose a mode."""
        raise ValueError(
            f"policy: found {type(self).__name__}, which chooses no modes, expected another "
            "policy; it stands only in comparisons"
        )


class _Function(Policy):
    """A policy without memory, made from a function of observations."""

    def __init__(self, act: Act) -> None:
        self._act = act

    def __call__(self, observation: NDArray[np.float32]) -> Any:
        return self._act(observation)


def is_agent(name: str) -> bool:
    """Return whether a name has the form module:function."""
    return MODULE.fullmatch(name) is not None


def agent_from(name: str) -> Act:
    """Return the agent that ``module:function`` makes; the function takes no arguments.

    The module is on ``sys.path`` or in the current folder.

    Raises:
        ValueError: the agent can't be made; the message says why.
    """
    module, _, path = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last, so that installed modules take precedence
    try:
        make: Any = importlib.import_module(module)
        for part in path.split("."):
            make = getattr(make, part)
        return cast(Act, make())
    except Exception as error:  # a user's code can raise anything
        raise ValueError(
            f"policy {name}: {in_one_line(error)}; expected module:function, a function "
            f"that takes no arguments and returns the agent ({GUIDE})"
        ) from error


def tried(name: str, agent: Act, table: Observation) -> Policy:
    """Return an agent as a policy; check that it returns actions for a few random observations.

    Its optional method ``reset(begins)`` is called, too. An estimator is returned as it is.

    Raises:
        ValueError: the agent is not a function, raises, or does not return actions.
    """
    if isinstance(agent, Estimator):
        return agent
    if not callable(agent):
        raise ValueError(
            f"policy {name}: found {agent!r}, expected a function from observations (n, features) "
            f"to actions (n,); {OF_A_MODEL} ({GUIDE})"
        )
    policy = cast(Policy, agent if hasattr(agent, "reset") else _Function(agent))
    space, rng = table.space, np.random.default_rng(0)
    shown = rng.uniform(space.low, space.high, (TRIED, len(table))).astype(np.float32)
    try:
        policy.reset(np.ones(TRIED, np.bool_))
        actions = np.asarray(policy(shown))
    except Exception as error:  # a user's code can raise anything
        raise ValueError(
            f"policy {name}: {in_one_line(error)}; it was given observations "
            f"{shown.shape}, float32, made with {table.made_with}; {OF_A_MODEL} ({GUIDE})"
        ) from error
    require_actions(name, actions, TRIED, len(table.actions))
    return policy


def in_one_line(error: Exception) -> str:
    """Return the type and the first line of an exception that a user's code raised."""
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"


def require_beliefs(
    name: str, returned: Any, shape: tuple[int, int], layout: Layout
) -> tuple[Array, Array]:
    """Return an estimator's means and packed covariances; refuse arrays of other shapes."""
    wanted = [(*shape, layout.state_size), (*shape, layout.triangle)]
    found = [np.shape(part) for part in returned]
    if found != wanted:
        raise ValueError(f"beliefs of {name}: found shapes {found}, expected {wanted} ({GUIDE})")
    return returned[0], returned[1]


def require_actions(name: str, returned: Any, n: int, count: int) -> NDArray[np.integer[Any]]:
    """Return actions (n,) as an array; refuse anything else.

    Raises:
        ValueError: ``returned`` does not hold n integers from 0 to ``count`` - 1, one for each
            observation.
    """
    actions: NDArray[Any] = np.asarray(returned)
    if actions.shape != (n,) or actions.dtype.kind not in "iu":
        raise ValueError(
            f"actions of {name}: found shape {actions.shape} of {actions.dtype}, expected ({n},) "
            f"of integers, one for each row of the observations; {OF_A_MODEL} ({GUIDE})"
        )
    if actions.min() < 0 or actions.max() >= count:
        raise ValueError(
            f"actions of {name}: found {actions.min()} to {actions.max()}, expected 0 to "
            f"{count - 1}"
        )
    return actions
