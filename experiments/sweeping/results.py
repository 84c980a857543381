"""What a sweep came to: a Parquet data set, partitioned by run, that grows cell by cell."""

import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from experiments.evaluation.intervals import Interval, bootstrap
from experiments.sweeping.cell import HYPERPARAMETER, Cell
from experiments.sweeping.spec import Spec
from mmwave_env.files import atomic_path, write_bytes
from mmwave_env.lookup import require_extra
from mmwave_env.metrics import METRICS

CELL, KIND = "cell", "kind"  # columns that say which cell a row is of, and what it did
EPISODE = ("episode_seed", "episode_key")  # columns that say which episode a row is
_WHOLE = "[!.]*.parquet"  # hidden ones are what kill -9 left half written
_EVERY_S = 1.0  # cells that are over within it share a file
_MOST_ROWS = 100_000  # so do no more: what waits is in memory


class ResultSet:
    """The partition of a run: files of whole cells, each there or not.

    Args:
        out: folder of the data set.
        spec: what is to be done.

    Attributes:
        folder: of the run.
    """

    def __init__(self, out: Path, spec: Spec) -> None:
        require_extra("pyarrow", "sweep", "sweep")
        self.folder, self._spec = out / f"run={spec.run}", spec
        self._mixed = len({cell.kind for cell in spec.cells}) > 1
        self._told = [axis for axis in spec.axes if axis == "policy" or self._varies(axis)]
        self._waiting: list[tuple[Cell, Mapping[str, Any]]] = []
        self._rows_waiting = 0
        self._written_s = time.monotonic()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Nobody else writes to the run meanwhile; what waits is written at the end.

        Raises:
            BlockingIOError: somebody else does.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / ".lock").open("w") as file:
            _lock(file.fileno(), self.folder)
            try:
                yield
            finally:
                self.flush()

    def finished(self) -> set[str]:
        """Names of the cells that are there.

        Raises:
            ValueError: a file can't be read, or the policy of a training is missing; the message
                names it.
        """
        from pyarrow import ArrowException, parquet

        def cells(path: Path) -> set[str]:
            try:
                return {*parquet.read_table(path, columns=[CELL])[CELL].unique().to_pylist()}
            except (ArrowException, OSError) as error:
                raise ValueError(
                    f"{path}: found no readable Parquet ({error}); remove it, and its cells are "
                    "computed again"
                ) from error

        there = set[str]()
        for path in self.folder.glob(_WHOLE):
            there |= (found := cells(path))
            for cell in self._spec.cells:
                if (
                    cell.kind == "train"
                    and cell.name in found
                    and not self.policy_of(cell).is_file()
                ):
                    raise ValueError(
                        f"{self.policy_of(cell)}: found no such file, expected the policy of a "
                        f"training in {path}; remove that, and its cells are computed again"
                    )
        return there

    def add(self, cell: Cell, result: Mapping[str, Any]) -> None:
        """Keep a cell; it is on disk within a second of the next ones, and at the end."""
        if "policy" in result:
            write_bytes(self.policy_of(cell), result["policy"])
        self._waiting.append((cell, result))
        self._rows_waiting += len(result["episode_seed"])
        if time.monotonic() - self._written_s >= _EVERY_S or self._rows_waiting >= _MOST_ROWS:
            self.flush()

    def flush(self) -> None:
        """Write what waits, in one file, beside and renamed."""
        if not self._waiting:
            return
        from pyarrow import parquet

        table, told = self._table(), "".join(cell.name for cell, _ in self._waiting)
        name = f"cells-{hashlib.sha256(told.encode()).hexdigest()[:16]}.parquet"
        with atomic_path(self.folder / name) as temporary:
            parquet.write_table(table, temporary)
        self._waiting, self._rows_waiting, self._written_s = [], 0, time.monotonic()

    def _table(self) -> Any:
        """What waits, a row an episode: the cell, its axes as text, the episode, its metrics."""
        import pyarrow

        rows = [len(result["episode_seed"]) for _, result in self._waiting]
        texts = [_as_text(cell) | {CELL: cell.name, KIND: cell.kind} for cell, _ in self._waiting]

        def text(name: str) -> Any:
            each = np.repeat([said.get(name) for said in texts], rows)
            return pyarrow.array(each, pyarrow.string())

        def joined(values: Iterable[Sequence[Any]], kind: Any) -> Any:
            return pyarrow.array(list(chain.from_iterable(values)), kind)

        results = [result for _, result in self._waiting]
        columns = {name: text(name) for name in (CELL, KIND)}
        columns |= {column_of(axis): text(axis) for axis in self._spec.axes}
        for name, kind in zip(EPISODE, (pyarrow.int64(), pyarrow.uint64()), strict=True):
            columns[name] = joined((result[name] for result in results), kind)
        for metric in METRICS:
            columns[metric] = joined((r["scores"][metric] for r in results), pyarrow.float64())
        return pyarrow.table(columns)

    def summary(self) -> dict[str, dict[str, Interval]]:
        """Means with intervals over episodes by combination, in the order of the file.

        First seeds of episodes are left out; every training has a row of its own, because episodes
        of one training do not tell how another would have gone. Of a search the best comes first.
        """
        from pyarrow import compute

        if not any(self.folder.glob(_WHOLE)):
            return {}
        # In an order of their own, so that intervals do not depend on which cell was done first.
        table = self._rows().sort_by([(name, "ascending") for name in (CELL, *EPISODE)])
        if "seed" in self._spec.axes:
            trained = compute.equal(table[KIND], "train")
            seeds = compute.if_else(trained, table["seed"], None)
            table = table.set_column(table.schema.get_field_index("seed"), "seed", seeds)
        keys = [KIND, *map(column_of, self._spec.axes)]
        grouped = table.group_by(keys, use_threads=False).aggregate([(m, "list") for m in METRICS])
        rows = {}
        for row in grouped.to_pylist():
            values = np.array([row[f"{m}_list"] for m in METRICS]).T
            intervals = dict(zip(METRICS, bootstrap(values), strict=True))
            said = {axis: row[column_of(axis)] for axis in self._spec.axes}
            rows[self._label(row[KIND], said)] = intervals
        if self._spec.search is not None:
            return dict(sorted(rows.items(), key=lambda row: -row[1]["reward"].mean))
        labels = (self.label(cell) for cell in self._spec.cells)
        return {label: rows[label] for label in dict.fromkeys(labels) if label in rows}

    def label(self, cell: Cell) -> str:
        """What the row of the summary is called that a cell belongs to."""
        values = _as_text(cell)
        if cell.kind == "evaluate":
            values.pop("seed", None)
        return self._label(cell.kind, values)

    def _label(self, kind: str, values: Mapping[str, str | None]) -> str:
        """What is not the same in all cells, and always who was evaluated."""
        parts = [f"{axis} {values[axis]}" for axis in self._told if values.get(axis) is not None]
        return ", ".join([kind] * (self._mixed or not parts) + parts)

    def policy_of(self, cell: Cell) -> Path:
        """The file of what a training came to."""
        return self.folder / "policies" / f"{cell.name}.safetensors"

    def best(self) -> dict[str, Any]:
        """Hyperparameters of the training with the greatest mean reward, by axis."""
        rewards = self._rows().group_by([CELL], use_threads=False)
        axes = [axis for axis in self._spec.axes if axis.startswith(HYPERPARAMETER)]
        means = rewards.aggregate([("reward", "mean"), *((axis, "min") for axis in axes)])
        (best,) = means.sort_by([("reward_mean", "descending")]).slice(0, 1).to_pylist()
        found = {axis: json.loads(best[f"{axis}_min"]) for axis in axes}
        return {axis: tuple(v) if isinstance(v, list) else v for axis, v in found.items()}

    def _rows(self) -> Any:
        from pyarrow import dataset

        found = dataset.dataset(self.folder, format="parquet", exclude_invalid_files=True)
        return found.to_table()

    def _varies(self, axis: str) -> bool:
        if self._spec.search is not None:
            return axis in dict(self._spec.search.free)
        return len({dict(cell.values).get(axis) for cell in self._spec.cells}) > 1


def column_of(axis: str) -> str:
    """Where rows have the value of an axis: the option ``reward`` is not the metric."""
    return f"{axis}_{KIND}" if axis in METRICS else axis


def _as_text(cell: Cell) -> dict[str, str | None]:
    """Values by axis as rows hold them."""
    return {a: value if isinstance(value, str) else json.dumps(value) for a, value in cell.values}


def _lock(descriptor: int, folder: Path) -> None:
    """Take a lock that ends with this process, however it ends."""
    if os.name != "posix":
        return
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise BlockingIOError(
            f"{folder}: found another sweep at work there, expected none"
        ) from None
