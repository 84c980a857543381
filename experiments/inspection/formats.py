"""Which format a path is in, by its name and its first line; and the data set that it holds."""

import csv
import gzip
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from experiments.inspection.data_set import DataSet
from experiments.inspection.logs import log_data_set, paths_data_set
from experiments.inspection.tracks import (
    scenario_data_set,
    traffic_data_set,
    tum_data_set,
    way_data_set,
)
from mmwave_env.episodes.deepmimo.formats import is_scenario
from mmwave_env.episodes.deepmimo.params import PARAMS
from mmwave_env.episodes.fcd import SUFFIXES, is_fcd
from mmwave_env.episodes.log_folder import SCENE, TRUTH, log_of
from mmwave_env.episodes.samples import sample_folder, sample_names
from mmwave_env.episodes.tables import TRAJECTORY
from mmwave_env.episodes.traffic import Traffic, read_traffic
from mmwave_env.episodes.waypoints import WAYPOINT
from mmwave_env.files import open_regular

_FIRST_LINE = 1 << 16  # bytes of a file that are looked at


@dataclass(frozen=True)
class Beside:
    """What the user says about a log."""

    scene: str | None  # name or file
    truth: Path | None
    radio: str


class Format(NamedTuple):
    """How one is told, and read."""

    said: str  # for who gave something else
    holds: Callable[[Path, Sequence[str]], bool]  # by path and columns of its first line
    read: Callable[[Path, Beside], DataSet]


def _log(path: Path, beside: Beside) -> DataSet:
    scene, truth = path.parent / SCENE, path.parent / TRUTH
    if beside.scene is None and not scene.exists():
        raise ValueError(f"scene: found none, and no {scene}; expected --scene, whose anchors "
                         f"{path} is about")  # fmt: skip
    found = beside.truth or (truth if truth.exists() else None)
    where = beside.scene or str(scene)
    if "anchor" not in _columns(path):
        return paths_data_set(path, where, found)
    return log_data_set(path, where, found, beside.radio)


FORMATS = (
    Format(
        f"the folder of a DeepMIMO scenario, with {PARAMS}",
        lambda path, columns: is_scenario(path),
        lambda path, beside: scenario_data_set(path),
    ),
    Format(
        f"the folder of a measurement log, with {SCENE} and {TRUTH}",
        lambda path, columns: path.is_dir(),
        lambda path, beside: _log(log_of(path), beside),
    ),
    Format(
        "a track in TUM format (.tum)",
        lambda path, columns: path.suffix.lower() == ".tum",
        lambda path, beside: tum_data_set(path),
    ),
    Format(
        f"traffic of SUMO ({', '.join(SUFFIXES)})",
        lambda path, columns: (
            ".xml" in path.suffixes
            or "timestep_time" in columns
            or (path.suffix.lower() == ".csv" and is_fcd(path))
        ),
        lambda path, beside: traffic_data_set(Traffic(str(path))),
    ),
    Format(
        "a choice of its trips (.json)",
        lambda path, columns: path.suffix.lower() == ".json",
        lambda path, beside: traffic_data_set(read_traffic(path)),
    ),
    Format(
        f"a way (.csv with the columns {','.join(TRAJECTORY[:4])}, or of way-points)",
        lambda path, columns: {*TRAJECTORY[:4]} <= {*columns} or {*WAYPOINT[:4]} <= {*columns},
        lambda path, beside: way_data_set(path),
    ),
    Format(
        "a measurement log (.csv, .csv.gz, .parquet)",
        lambda path, columns: len(columns) > 1,
        _log,
    ),
)


def data_set_of(name: str, beside: Beside) -> DataSet:
    """The data set of a path, or of the name of a recording of the package.

    Raises:
        FileNotFoundError: there is nothing of that name.
        ValueError: it is in none of the formats, or damaged from its beginning on.
        OSError: it can't be read.
    """
    path = sample_folder(name, "recording") if name in sample_names() else Path(name)
    if not path.exists():
        raise FileNotFoundError(
            f"{path}: found nothing, expected a file, a folder or one of "
            f"{', '.join(sample_names())}"
        )
    columns = () if path.is_dir() else _columns(path)
    for one in FORMATS:
        if one.holds(path, columns):
            return one.read(path, beside)
    raise ValueError(f"{path}: found none of the formats known, expected "
                     f"{'; '.join(one.said for one in FORMATS)}")  # fmt: skip


def _columns(path: Path) -> Sequence[str]:
    """The names in the first line of a table; nothing of what is none."""
    if path.suffix.lower() == ".parquet":
        from mmwave_env.logs.log_tables import parquet_names

        return parquet_names(path)
    if not path.name.lower().endswith((".csv", ".csv.gz")):
        return ()
    with open_regular(path) as plain, ExitStack() as stack:
        packed = path.suffix.lower() == ".gz"
        file = stack.enter_context(gzip.open(plain)) if packed else plain
        try:
            line = file.readline(_FIRST_LINE).decode("utf-8-sig")
        except (UnicodeDecodeError, EOFError, OSError):
            return ()
    divider = max(",;\t", key=line.count)
    return [name.strip() for name in next(csv.reader([line], delimiter=divider), [])]
