"""Rows of a sweep: a folder of Parquet files, one file with one row for each cell."""

from pathlib import Path

from experiments.sweeping.spec import Spec, Values, plain
from mmwave_env.io.files import atomic_path, told, write_bytes


def kept(folder: Path, spec: Spec) -> set[str]:
    """Return the names of the cells, or trials, of a sweep whose rows are in a folder.

    Raises:
        ValueError: the folder has a row of another sweep.
    """
    names = {path.stem for path in folder.glob("[!.]*.parquet")}  # hidden files are incomplete
    for name in names:
        if not (name.startswith(spec.trial) if spec.free else name in spec.cells):
            raise ValueError(
                f"{folder / name}.parquet: found a row of another sweep, or of this one by another "
                "version or before a file that it names was changed; --out names another folder"
            )
    return names


def keep(folder: Path, name: str, values: Values, result: Values) -> None:
    """Write the row of a cell, and with it the policy of a training."""
    import pyarrow
    from pyarrow import parquet

    row = {axis: plain(value) for axis, value in values.items()} | dict(result)
    if "policy_file" in row:
        write_bytes(folder / f"{name}.safetensors", row.pop("policy_file"))
    with atomic_path(folder / f"{name}.parquet") as temporary:
        parquet.write_table(pyarrow.Table.from_pylist([row]), temporary)


def read(folder: Path, spec: Spec) -> dict[str, Values]:
    """Read the rows of a sweep, by the name of their cell.

    Raises:
        ValueError: same as from :func:`kept`, or a file can't be read; the message names it.
    """
    from pyarrow import ArrowException, parquet

    rows = {}
    for name in sorted(kept(folder, spec)):
        path = folder / f"{name}.parquet"
        try:
            (rows[name],) = parquet.read_table(path).to_pylist()
        except (ArrowException, OSError, ValueError) as error:
            raise ValueError(f"{path}: found no row ({told(error)}); remove it") from error
    return rows
