"""Parquet table of every epoch of an evaluation, for other programs (extra ``data``)."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import EpochResults, Watch
from experiments.evaluation.seeds import Selection
from mmwave_env import __version__
from mmwave_env.files import atomic_path, require_writable
from mmwave_env.localization.position_errors import (
    horizontal,
    horizontal_level,
    vertical,
    vertical_level,
)
from mmwave_env.lookup import printable, require_extra
from mmwave_env.metrics import scored
from mmwave_env.models.measurement import Layout
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode, EpisodeSource

PARTS = ("x", "P", "memory.mode", "memory.nis", "memory.accepted")  # entries of the state
COLUMNS = {  # name: pyarrow's type, and meaning
    "policy": ("string", "name"),
    "seed": ("int64", "of the episode"),
    "key": ("uint64", "of the episode; null of recorded ones"),
    "epoch": ("int32", "number in the episode, from 0"),
    "time_s": ("float64", "since the first epoch"),
    "counts": ("bool", "whether averages count it: not the first 10 epochs"),
    "mode": ("string", "what the policy chose; of an IMM the most probable mode"),
    "reward": ("float64", "of the epoch"),
    "true_x_m": ("float64", "true position along x"),
    "true_y_m": ("float64", "along y"),
    "true_z_m": ("float64", "along z"),
    "x_m": ("float64", "estimated position along x"),
    "y_m": ("float64", "along y"),
    "z_m": ("float64", "along z"),
    "error_m": ("float64", "length of the difference of both"),
    "horizontal_error_m": ("float64", "its length in x and y"),
    "vertical_error_m": ("float64", "its size in z; null where the height is known"),
    "horizontal_level_m": ("float64", "protection level at the risk in the metadata"),
    "vertical_level_m": ("float64", "the same; null where the height is known"),
    "nees": ("float64", "of the position"),
}
GROUP_COLUMNS = {  # per group of measurements, with its name in front, such as doppler_nis
    "nis": ("float64", "of the mode that ran; null where it was not measured"),
    "accepted": ("bool", "whether it passed its gate; null where it was not measured"),
}
ROWS_PER_GROUP = 1 << 16


def require_parquet(path: Path) -> None:
    """Refuse a table that could not be written, before any work.

    Raises:
        ValueError: the name does not end with .parquet.
        MissingExtraError: pyarrow is not installed.
        OSError: the file can't be written.
    """
    if path.suffix != ".parquet":
        raise ValueError(f"epochs_parquet: found {path}, expected a name that ends with .parquet")
    require_extra("pyarrow", "data", "epochs_parquet, a Parquet file,")
    require_writable(path)


@contextmanager
def epochs_parquet(
    path: Path,
    names: Mapping[str, str],
    selection: Selection,
    source: EpisodeSource,
    risk: float,
    planar: bool = False,
) -> Iterator[Watch]:
    """Yield a function that writes the epochs of contenders; the finished table is moved to path.

    Args:
        path: file of the table, which is written one chunk of episodes at a time.
        names: names in the column "policy", by contender; other contenders are skipped.
        selection, source: episodes that are played.
        risk: integrity risk of protection levels.
        planar: whether the height is known.
    """
    from pyarrow.parquet import ParquetWriter

    schema, taken = _schema(source, risk), dict.fromkeys(names, 0)
    with atomic_path(path) as temporary, ParquetWriter(temporary, schema) as writer:

        def add(contender: Contender, episodes: Sequence[Episode], told: EpochResults) -> None:
            if contender.name not in names:
                return
            part = selection.part(taken[contender.name], len(episodes))
            taken[contender.name] += len(episodes)
            columns = {
                "policy": np.array(printable(names[contender.name]), object),
                **_which(part, source, episodes),
                "mode": _mode(contender, told),
                **_positions(episodes, told, risk, planar),
                **_groups(episodes, told),
            }
            writer.write_table(_table(columns, schema), row_group_size=ROWS_PER_GROUP)

        yield add


def columns_of(layout: Layout) -> dict[str, tuple[str, str]]:
    """Return the type and meaning of all columns, by name, for a layout of measurements."""
    of_groups = {
        f"{name}_{what}": column
        for name in _group_names(layout)
        for what, column in GROUP_COLUMNS.items()
    }
    return COLUMNS | of_groups


def _group_names(layout: Layout) -> list[str]:
    return [name.lower().replace(" ", "_") for name in layout.group_names]


def _schema(source: EpisodeSource, risk: float) -> Any:
    import pyarrow

    fields = [
        pyarrow.field(name, pyarrow.type_for_alias(kind), metadata={"description": what})
        for name, (kind, what) in columns_of(source.layout).items()
    ]
    made = {"made_by": f"mmwave-loc {__version__}", "scenario": source.name, "risk": f"{risk:g}"}
    return pyarrow.schema(fields, metadata=made)


def _table(columns: Mapping[str, Any], schema: Any) -> Any:
    """Make a table of columns that broadcast to (n, T), null where they are masked."""
    import pyarrow

    def column(field: Any) -> Any:
        values = np.broadcast_to(columns[field.name], shape, subok=True)
        null = np.ma.getmaskarray(values).ravel()
        return pyarrow.array(np.ma.getdata(values).ravel(), field.type, mask=null)

    shape = columns["nees"].shape
    return pyarrow.table([column(field) for field in schema], schema=schema)


def _which(part: Selection, source: EpisodeSource, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the columns that identify the epoch and its episode."""
    epochs, keys = len(episodes[0]), part.keys(source)
    counts = np.zeros(epochs, bool)
    counts[scored(epochs)] = True
    none: Any = np.ma.array(np.zeros((len(episodes), epochs), np.uint64), mask=True)
    return {
        "seed": np.array(part.seeds)[:, None],
        "key": none if keys is None else keys[:, None],
        "epoch": np.arange(epochs),
        "time_s": np.stack([episode.time_s - episode.time_s[0] for episode in episodes]),
        "counts": counts,
    }


def _mode(contender: Contender, told: EpochResults) -> Any:
    if "mode" in told:
        return np.array(contender.actions, object)[told["mode"]]
    names = [mode.name for mode in contender.modes]
    return np.array(names, object)[told["memory.mode"].astype(int)]


def _positions(
    episodes: Sequence[Episode], told: EpochResults, risk: float, planar: bool
) -> dict[str, Any]:
    """Return the columns of truth, estimate, errors, protection levels and NEES."""
    error, P = told["error"], told["P"]
    truth = np.stack([cast(Array, episode.truth_position_m) for episode in episodes])
    level = np.full(error.shape[:2], np.nan) if planar else vertical_level(P, risk)
    return {
        "reward": told["reward"],
        **{f"true_{axis}_m": truth[..., i] for i, axis in enumerate("xyz")},
        **{f"{axis}_m": told["x"][..., i] for i, axis in enumerate("xyz")},
        "error_m": np.linalg.norm(error, axis=-1),
        "horizontal_error_m": horizontal(error),
        "vertical_error_m": np.ma.array(vertical(error), mask=planar),
        "horizontal_level_m": horizontal_level(P, risk),
        "vertical_level_m": np.ma.array(level, mask=planar),
        "nees": told["nees"],
    }


def _groups(episodes: Sequence[Episode], told: EpochResults) -> dict[str, Any]:
    """Return the columns of NIS and gates of every measurement group."""
    missing = ~np.stack([episode.usable for episode in episodes])
    found = {"nis": told["memory.nis"], "accepted": told["memory.accepted"] > 0.5}
    return {
        f"{name}_{what}": np.ma.array(values[..., i], mask=missing[..., i])
        for i, name in enumerate(_group_names(episodes[0].layout))
        for what, values in found.items()
    }
