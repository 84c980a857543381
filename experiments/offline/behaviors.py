"""Policies that act in one environment: a data set has one space of actions."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from experiments.evaluation.contenders import POLICY_SEED, Contender, contenders
from mmwave_env.filters.bank import Bank, bank_as_written
from mmwave_env.filters.mode_files import as_written
from mmwave_env.observation import Observation
from mmwave_env.task import Modes, bank_and_modes
from policies import FixedMode, Policy, RandomMode

# What has no modes of its own: it acts in the environment of others.
_GUESTS = ("random", "imm", "speed-rule", "likelihood-rule")
_GUEST_PREFIXES = ("fixed-", "trust-")


def behaviors(
    names: Sequence[str],
    radio: str,
    trained: Callable[[str], Contender],
    modes: Modes = None,
    beliefs: str = "shared",
    observation: str = "full",
) -> list[Contender]:
    """Contenders that see the same and choose from the same actions.

    The environment is that of those who were trained. All others act in it: always in one mode, by
    a rule, or at random. Where every mode keeps its own belief, "imm" trusts none of them, and
    "trust-NAME" always the same one.

    Args:
        names: of the contenders.
        radio: profile.
        trained: a contender that brings its modes, by its name.
        modes, beliefs, observation: of the environment where nobody brings them, as of
            ``MmWaveLoc-v0``.

    Raises:
        ValueError: no name, or one twice; trained ones of several environments; what chooses no
            action, or none of this environment's.
    """
    if not names or len(set(names)) < len(names):
        raise ValueError(f"policies: found {', '.join(names) or 'none'}, expected each name once")
    hosts = {name: trained(name) for name in names if not _is_guest(name)}
    if hosts:
        first, *others = hosts.values()
        for host in (first, *others):
            _require_alike(first, host)
        bank, modes, observation = first.bank, first.modes, first.observation
    else:
        bank, modes = bank_and_modes(modes, beliefs, radio)
    guests = _who_trust(bank) if bank else _who_choose(modes, radio, observation)
    missing = [name for name in names if name not in hosts and name not in guests]
    if missing:
        where = f" beside {', '.join(hosts)}" if hosts else ""
        raise ValueError(
            f"policies: found {missing[0]!r}{where}, expected what acts in this environment: "
            f"{', '.join(guests)}"
        )
    return [
        hosts[name] if name in hosts else replace(guests[name](), observation=observation)
        for name in names
    ]


def environment_of(contender: Contender) -> dict[str, Any]:
    """What a contender's environment is made with, as JSON holds it: all numbers of its modes.

    Raises:
        ValueError: a mode's algorithm is a function, which no file can hold.
    """
    modes = {"modes": [as_written(mode) for mode in contender.modes]}
    return {
        "modes": bank_as_written(contender.bank) if contender.bank else modes,
        "beliefs": contender.beliefs,
        "observation": contender.observation,
    }


def _is_guest(name: str) -> bool:
    return name in _GUESTS or name.startswith(_GUEST_PREFIXES)


def _who_trust(bank: Bank) -> dict[str, Callable[[], Contender]]:
    """Who needs no training where every mode of a bank keeps its own belief, by name."""

    def made(name: str, policy: Callable[[Observation], Policy]) -> Contender:
        return Contender(
            name, bank.modes, policy, bank.transition, bank.nis_quantile, beliefs="per-mode"
        )

    trusted = {"imm": 0} | {f"trust-{mode.name}": i for i, mode in enumerate(bank.modes, 1)}
    policies: dict[str, Callable[[Observation], Policy]] = {
        name: lambda table, action=action: FixedMode(action)  # type: ignore[misc]
        for name, action in trusted.items()
    }
    policies["random"] = lambda table: RandomMode(len(trusted), POLICY_SEED)
    return {name: partial(made, name, policy) for name, policy in policies.items()}


def _who_choose(modes: Modes, radio: str, observation: str) -> dict[str, Callable[[], Contender]]:
    """Who needs no training where modes share a belief, by name."""
    known = contenders(radio, modes)
    del known["imm"]  # which chooses no mode
    if observation == "prior":
        known.pop("likelihood-rule", None)  # which compares how modes see the coming epoch
    return known


def _require_alike(first: Contender, other: Contender) -> None:
    """Refuse an IMM, and contenders of two environments."""
    if other.policy is None:
        raise ValueError(
            f"policies: found {other.name!r}, an IMM, expected what chooses modes; imm beside "
            "policies with beliefs per mode is the IMM over their modes"
        )
    if environment_of(first) != environment_of(other):
        one, two = (
            f"{c.name} ({', '.join(c.actions)}; {c.beliefs}, {c.observation})"
            for c in (first, other)
        )
        raise ValueError(
            f"policies: found {one} and {two}, expected one environment: a data set has one space "
            "of actions; collect them one by one, with another --id each"
        )
