"""Agents of one's own: functions from observations to actions, tried before an episode runs."""

import importlib
import os
import re
import sys
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from mmwave_env.observation import Observation
from policies import Policy

Act = Callable[[NDArray[np.float32]], Any]  # observations (n, features) -> actions (n,)

MODULE = re.compile(r"[\w.]+:[\w.]+")
GUIDE = "docs/own-agent.md"
OF_A_MODEL = "of a model, lambda seen: model.predict(seen, deterministic=True)[0]"
TRIED = 3  # observations to try an agent on


class _Function(Policy):
    """A function of observations as a policy, which has nothing to forget."""

    def __init__(self, act: Act) -> None:
        self._act = act

    def __call__(self, observation: NDArray[np.float32]) -> Any:
        return self._act(observation)


def is_agent(name: str) -> bool:
    """Tell whether a name is that of a function in a module."""
    return MODULE.fullmatch(name) is not None


def agent_from(name: str) -> Act:
    """Return the agent of ``module:function``.

    Args:
        name: of a function without arguments, in a module on ``sys.path`` or in the current
            folder, that returns the agent.

    Raises:
        ValueError: naming the module, and what is wrong with it.
    """
    module, _, path = name.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last: what is installed goes first
    try:
        found: Any = importlib.import_module(module)
        for part in path.split("."):
            found = getattr(found, part)
        return cast(Act, found())
    except Exception as error:  # whatever a user's code does
        raise ValueError(
            f"policy {name}: {in_one_line(error)}; expected module:function, a function "
            f"without arguments that returns the agent ({GUIDE})"
        ) from error


def tried(name: str, agent: Act, table: Observation) -> Policy:
    """An agent as a policy, if it gives actions for observations of a table of features.

    Args:
        name: of the agent, for errors.
        agent: what it is; its method ``reset(begins)``, if there is one, is called too.
        table: what it is shown.

    Raises:
        ValueError: it is no function, fails, or returns no actions.
    """
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
        found = policy(shown)
    except Exception as error:  # whatever a user's code does
        raise ValueError(
            f"policy {name}: {in_one_line(error)}; it was shown observations "
            f"{shown.shape} of float32: {table.made_with} ({GUIDE})"
        ) from error
    require_actions(name, found, TRIED, len(table.actions))
    return policy


def in_one_line(error: Exception) -> str:
    """What somebody else's code raised."""
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"


def require_actions(name: str, found: Any, n: int, count: int) -> NDArray[np.integer[Any]]:
    """Actions (n,) as an array.

    Raises:
        ValueError: they are not one of ``count`` actions, by its number, for each of n
            observations.
    """
    try:
        actions: NDArray[Any] = np.asarray(found)
    except ValueError:  # parts of different shapes
        raise ValueError(
            f"actions of {name}: found a {type(found).__name__} of parts that are no array, "
            f"expected ({n},) of integers; {OF_A_MODEL} ({GUIDE})"
        ) from None
    if actions.shape != (n,) or actions.dtype.kind not in "iu":
        raise ValueError(
            f"actions of {name}: found shape {actions.shape} of {actions.dtype}, expected ({n},) "
            f"of integers, one for each row of the observations ({GUIDE})"
        )
    if actions.min() < 0 or actions.max() >= count:
        raise ValueError(
            f"actions of {name}: found {actions.min()} to {actions.max()}, expected 0 to "
            f"{count - 1}"
        )
    return actions
