"""What a ``scenario=`` argument means: kinds of users, or ways that somebody went."""

import os
from pathlib import Path

from mmwave_env.episodes.fcd import SUFFIXES, is_fcd
from mmwave_env.episodes.mobility import Mobility, mobilities_of
from mmwave_env.episodes.traffic import Traffic, read_traffic
from mmwave_env.episodes.trajectory import Trajectory
from mmwave_env.episodes.waypoints import read_way
from mmwave_env.files import parse_json, read_text

Scenario = str | os.PathLike[str] | Mobility | Trajectory | Traffic
Users = tuple[Mobility, ...] | Trajectory | Traffic


def users_of(scenario: Scenario) -> Users:
    """Kinds of users that are drawn, or the ways of some.

    Raises:
        ValueError: unknown scenario; the message lists the valid ones. Or a file that holds
            something else than it should.
        FileNotFoundError: there is no such file.
    """
    if isinstance(scenario, Trajectory | Traffic):
        return scenario
    if isinstance(scenario, Mobility):
        return (scenario,)
    path = Path(str(scenario))
    if path.name.lower().endswith(SUFFIXES):
        return Traffic(os.fspath(scenario)) if is_fcd(path) else read_way(scenario)
    if _holds_traffic(path):
        return read_traffic(path)
    return mobilities_of(scenario)


def _holds_traffic(path: Path) -> bool:
    """Whether a JSON file is about traffic; if it is broken, who reads it says so."""
    try:
        return path.suffix == ".json" and "fcd" in parse_json(read_text(path))
    except (ValueError, TypeError, OSError):
        return False
