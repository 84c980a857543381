"""Options of mmwave-loc list."""

from dataclasses import dataclass, field
from typing import Literal

What = Literal["policies", "scenarios", "radios", "scenes", "modes", "samples", "rewards"]


@dataclass(kw_only=True)
class Args:
    """List what options and arguments of the environment take by name.

    mmwave-loc list policies
    """

    what: What | None = field(default=None, metadata={"positional": True})
    """policies, scenarios, radios, scenes, modes, samples or rewards; all where none is named"""
    radio: str = "handset"
    """profile whose policies and modes are listed"""
