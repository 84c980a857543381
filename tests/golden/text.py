"""Golden traces as text: exact numbers, a row an epoch, and read again cell by cell."""

import json
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

GENERATOR = "Written by `make golden` (tests/golden/write.py)."

Cells = dict[tuple[str, str], str]  # (row, column) -> what stands there


def word(value: object) -> str:
    """A value as a cell holds it: numbers in as few digits as give them back, flags as letters."""
    if isinstance(value, (bool, np.bool_)):
        return "T" if value else "F"
    if isinstance(value, np.float32):
        return str(value)
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    if isinstance(value, np.ndarray):  # of flags: numbers get a column each
        return "".join(map(word, value))
    return str(value)


def table(what: str, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> str:
    """A CSV file; a row is empty in the columns that it lacks.

    Args:
        what: for the comment in the first line.
        columns: names; the first one holds the names of the rows.
        rows: by column.
    """
    lines = [f"# {GENERATOR} {what}", ",".join(columns)]
    for row in rows:
        assert row.keys() <= set(columns), set(row) - set(columns)
        lines.append(",".join(word(row[name]) if name in row else "" for name in columns))
    return "\n".join(lines) + "\n"


def cells(name: str, text: str) -> Cells:
    """The cells of a file: CSV, JSON, or lines of a key and a value."""
    if name.endswith(".json"):
        return dict(_leaves((), json.loads(text)))
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    if not name.endswith(".csv"):
        return {(key, "value"): value for key, value in (line.split(" ", 1) for line in lines)}
    columns = lines[0].split(",")
    rows = [line.rsplit(",", len(columns) - 1) for line in lines[1:]]  # names of rows hold commas
    found = {
        (row[0], column): value for row in rows for column, value in zip(columns, row, strict=True)
    }
    assert len(found) == len(rows) * len(columns), f"{name}: two rows or columns of one name"
    return found


def _leaves(path: tuple[str, ...], tree: object) -> Iterable[tuple[tuple[str, str], str]]:
    """The leaves of a JSON object; a leaf's key is its column, what leads there its row."""
    if isinstance(tree, (dict, list)):
        for key, branch in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from _leaves((*path, str(key)), branch)
    else:
        yield ("/".join(path[:-1]), path[-1]), json.dumps(tree)
