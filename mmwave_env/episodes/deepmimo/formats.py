"""Which format of DeepMIMO a folder has."""

from pathlib import Path

from mmwave_env.episodes.deepmimo import params, v3
from mmwave_env.episodes.deepmimo.scenario import Scenario
from mmwave_env.episodes.deepmimo.v4 import open_v4
from mmwave_env.episodes.tables import refuse


def is_scenario(folder: Path) -> bool:
    """Whether a folder says of itself that it is a scenario."""
    return any((folder / name).exists() for name in (params.PARAMS, v3.PARAMS))


def open_scenario(folder: Path, receiver_set: int | None = None) -> Scenario:
    """What a folder holds, of version 4 or 3.

    Args:
        folder: of the scenario.
        receiver_set: number of a set of receivers, of version 4; None for the only one.

    Raises:
        FileNotFoundError: the folder or a file that must be there is missing.
        ValueError: a file can't be read or contradicts another, or there are several sets of
            receivers; the message names them.
    """
    if not folder.exists():
        raise FileNotFoundError(f"{folder}: found nothing, expected the folder of a scenario")
    if not folder.is_dir():
        refuse(folder, "folder", "a file", "the folder of a DeepMIMO scenario")
    if (folder / v3.PARAMS).exists() and not (folder / params.PARAMS).exists():
        return v3.open_v3(folder)
    return open_v4(folder, receiver_set)
