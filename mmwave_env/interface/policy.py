"""Policies, and what a filter needs to know of one.

A policy has two verbs: it chooses actions, and it may correct beliefs. Rules, learned networks and
users' agents all follow the protocol :class:`Policy`; code that runs filters asks for nothing else.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mmwave_env.filters.bank import Bank
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import ACTIONS, CORRECTION, MODE
from mmwave_env.interface.observation import Observation, action_names
from mmwave_env.io.lookup import choose
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch
from mmwave_env.numerics.numbers import Array, Array32, Index, Mask, Number, Vector

Rule = Callable[[Vector, Epoch], Number]
OF_A_MODEL = "for a model, use lambda seen: model.predict(seen, deterministic=True)[0]"


class Correction(NamedTuple):
    """Corrections of n beliefs after the latest epoch (:mod:`mmwave_env.filters.correction`).

    For n tracks of T epochs, arrays are (n, T, 3) and (n, T).

    Attributes:
        shift: (n, 3) shifts along and across the motion, and up, in standard deviations of the
            belief.
        log_factor: (n, 3) logarithms of factors for these standard deviations.
        trusted: (n,) trust, the factor, 0 to 1, by which the network's answer was scaled.
    """

    shift: NDArray[Any]
    log_factor: NDArray[Any]
    trusted: NDArray[Any]


@runtime_checkable
class Policy(Protocol):
    """A map from observations of n tracks to actions and, perhaps, corrections of the beliefs.

    Attributes:
        action: kind of its actions (:mod:`mmwave_env.interface.actions`). If it is "correction",
            :meth:`act` returns modes, and :meth:`correct` returns corrections.
        memory: arrays, each with a row per track, of all that the policy remembers of the past;
            a live localization of many users writes into them.
    """

    action: str = MODE
    memory: tuple[NDArray[Any], ...] = ()

    def reset(self, mask: Mask) -> None:
        """Forget the past of tracks where ``mask`` (n,) is True: new tracks begin there."""
        return  # a policy without a memory has no past to forget

    def act(self, observation: Array32) -> Index:
        """Return actions (n,), or weights (n, modes), for observations (n, features)."""
        ...

    def correct(self, observation: Array32) -> Correction | None:
        """Return corrections of the beliefs after the latest epoch; None without corrections.

        If the kind of actions is "correction", this is called once after every epoch. Of the
        observations (n, features), only the features of the latest epoch
        (:func:`~mmwave_env.interface.signed.after_update`) are always known.
        """
        return None


class CompiledPolicy(Policy):
    """A policy that corrects beliefs, and can play tracks in one call of compiled code."""

    @abstractmethod
    def play(self, stages: Any, actions: Index, outputs: Array, trusted: Array) -> bool:
        """Play the next T epochs of n tracks; return False if that is impossible.

        ``stages`` are a :class:`~mmwave_env.compiler.program.Stages`. The arrays (n, T), (n, T, k),
        (n, T) are filled with actions, output rows, and the factors that scaled the corrections.
        """


# A network that corrects n smoothed tracks: given their pipeline and whole tracks of features
# (n, T, features), it returns corrections (n, T, 3).
TrackCorrector = Callable[[Pipeline, Array32], Correction]


def policy_from(agent: Any, name: str) -> Policy:
    """Return a user's agent as a policy.

    Args:
        agent: a policy; or a function from observations (n, features) to actions (n,), which may
            have the methods ``reset`` and ``correct``; or to weights (n, modes), if its attribute
            ``action`` is "weights".
        name: name for the message of an error.

    Raises:
        ValueError: the agent is neither, or its kind of actions is unknown.
    """
    if isinstance(agent, Policy):
        return agent
    act = getattr(agent, "act", agent)
    if not callable(act):
        raise ValueError(
            f"{name}: found {agent!r}, expected a function from observations (n, features) to "
            f"actions (n,); {OF_A_MODEL}"
        )
    reset = getattr(agent, "reset", lambda mask: None)
    correct = getattr(agent, "correct", lambda observation: None)
    action = getattr(agent, "action", CORRECTION if hasattr(agent, "correct") else MODE)
    choose(ACTIONS, action, f"action of {name}")
    return cast(
        Policy, SimpleNamespace(act=act, reset=reset, correct=correct, action=action, memory=())
    )


@dataclass(eq=False)
class FixedMode(Policy):
    """A policy that always takes the same action; 0 leaves an IMM as it is."""

    number: int = 0

    def act(self, observation: Array32) -> Index:
        """Return actions (n,)."""
        return np.full(len(observation), self.number, np.int64)


@dataclass(frozen=True)
class Switching:
    """The modes of a track, and the rule or policy that chooses between them.

    Attributes:
        filters: one or several modes, of which one runs at a time; or a bank, whose modes interact.
        rule: function of (mean (7,) before the epoch, epoch) that returns the number of a mode;
            None with a bank or a policy.
        policy: function that makes a policy, given the table of features that the policy observes.
            The policy chooses the mode to run or, in a bank, the mode whose probability is raised.
            None for a rule, for a single mode, and for an IMM.
        observation: kind of observation that the policy reads: "full", "prior" or "signed".
    """

    filters: tuple[Mode, ...] | Bank
    rule: Rule | None = None
    policy: Callable[[Observation], Policy] | None = None
    observation: str = "full"

    @property
    def bank(self) -> Bank | None:
        """Return the bank; None if only one mode runs at a time."""
        return self.filters if isinstance(self.filters, Bank) else None

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Return the modes."""
        return self.filters.modes if isinstance(self.filters, Bank) else tuple(self.filters)

    @property
    def names(self) -> list[str]:
        """Return the names of the modes."""
        return [mode.name for mode in self.modes]

    @property
    def beliefs(self) -> str:
        """Return "per-mode" if every mode keeps its own belief, else "shared"."""
        return "per-mode" if self.bank else "shared"

    @property
    def actions(self) -> list[str]:
        """Return the names of the actions that the policy chooses from; without one, the modes'."""
        if self.policy is None:
            return self.names
        return action_names(self.modes, self.beliefs)

    def pipeline(self, layout: Layout, planar: bool) -> Pipeline:
        """Return the pipeline of the modes."""
        return Pipeline(self.modes, layout, planar)

    def start(self, layout: Layout, planar: bool = False) -> Policy:
        """Return a new policy for measurements with this layout; an IMM's always takes action 0."""
        if self.policy is None:
            return FixedMode()
        return self.policy(
            Observation(self.pipeline(layout, planar), self.observation, self.beliefs)
        )
