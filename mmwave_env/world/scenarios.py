"""What a ``scenario=`` argument means: kinds of users, or ways that users went."""

import os
from pathlib import Path

from mmwave_env.world.mobility import Mobility, mobilities_of
from mmwave_env.world.trajectory import Trajectory
from mmwave_env.world.ways import Ways, read_ways

Scenario = str | os.PathLike[str] | Mobility | Trajectory | Ways
_OF_SUMO = (".xml", ".gz", ".parquet")
Users = tuple[Mobility, ...] | Ways


def users_of(scenario: Scenario) -> Users:
    """Kinds of users that are drawn, or given ways.

    Raises:
        ValueError: unknown scenario; the message lists the valid ones. Or a file that holds
            something else than it should.
        FileNotFoundError: there is no such file.
    """
    if isinstance(scenario, Ways):
        return scenario
    if isinstance(scenario, Trajectory):
        return Ways(scenario.name, (scenario,))
    if isinstance(scenario, Mobility):
        return (scenario,)
    suffix = Path(str(scenario)).suffix.lower()
    if suffix == ".csv":
        return read_ways(scenario)
    if suffix in _OF_SUMO:
        raise ValueError(
            f"scenario: found {os.fspath(scenario)!r}, expected a .csv file of ways; "
            "examples/sumo.py makes one of SUMO's floating-car data"
        )
    return mobilities_of(scenario)
