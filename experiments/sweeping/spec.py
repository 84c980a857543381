"""What a sweep is to do: a TOML file of lists, every combination of which is a cell."""

import hashlib
import itertools
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from experiments.console.options import USUAL_EPISODES
from experiments.sweeping.cell import HYPERPARAMETER, KINDS, Cell, require_sound, values_of
from experiments.sweeping.named_files import digests
from experiments.sweeping.search import Search, search_from
from mmwave_env import __version__
from mmwave_env.files import read_text
from mmwave_env.lookup import as_name, choose


@dataclass(frozen=True)
class Spec:
    """A sweep.

    Attributes:
        name: of its file.
        cells: all that is to do, each once; of a search none are known before.
        search: for hyperparameters, in place of cells.
    """

    name: str
    cells: tuple[Cell, ...]
    search: Search | None = None

    def __len__(self) -> int:
        """How many cells it will have had."""
        return len(self.cells) if self.search is None else self.search.trials

    @property
    def axes(self) -> list[str]:
        """Names of all axes."""
        if self.search is not None:
            return self.search.axes
        return sorted({axis for cell in self.cells for axis, _ in cell.values})

    @property
    def trains(self) -> bool:
        """Whether there are trainings among them."""
        return self.search is not None or any(cell.kind == "train" for cell in self.cells)

    @property
    def run(self) -> str:
        """The name of its partition.

        Another sweep has another, and so has another version of the program, or the same sweep
        after a file that it names was changed.
        """
        what = [repr(self.search)] if self.search else sorted(cell.name for cell in self.cells)
        pairs = self.search.fixed if self.search else (v for c in self.cells for v in c.values)
        told = json.dumps([__version__, what, digests(value for _, value in pairs)])
        return f"{self.name}-{hashlib.sha256(told.encode()).hexdigest()[:8]}"


def read_spec(path: Path) -> Spec:
    """The sweep of a TOML file.

    A table ``[evaluate]`` has the options of ``mmwave-loc compare`` and ``policy``; a table
    ``[train]`` those of ``mmwave-loc train``, the ``seed`` of the training, ``episodes`` to judge
    it on, and a table ``[train.hyperparameters]``. A list is an axis, anything else a constant;
    ``modes`` and ``places`` are lists themselves, so that an axis of them is a list of lists. A
    table ``[search]`` stands alone: it is that of a training whose hyperparameters have ranges.

    Raises:
        ValueError: naming the file, the key, what was found and what was expected.
        FileNotFoundError: there is no such file.
    """
    text = read_text(path, "a sweep, TOML")
    try:
        content = _toml().loads(text)
        if "search" in content:
            return Spec(as_name(path.stem), (), search_from(content))
        return Spec(as_name(path.stem), tuple(_cells(content)))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not a sweep: {error} (docs/sweep.md)") from error


def _toml() -> Any:
    return import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


def _cells(content: Mapping[str, Any]) -> Iterator[Cell]:
    if not content:
        raise ValueError(f"found nothing, expected a table [{'] or ['.join(KINDS)}]")
    seen = set[Cell]()
    for kind, table in content.items():
        needed, known = choose(KINDS, kind, "table")
        if not isinstance(table, dict):
            raise ValueError(f"{kind}: found {table!r}, expected a table")
        axes = dict(_axes(kind, table, known))
        for axis in needed - set(axes):
            raise ValueError(f"{kind}.{axis}: found none, expected one")
        for values in itertools.product(*axes.values()):
            cell = Cell(kind, tuple(sorted(zip(axes, values, strict=True))))
            require_sound(cell)
            if cell in seen:
                raise ValueError(f"{kind}: found {cell} twice, expected each combination once")
            seen.add(cell)
            yield cell
        if kind == "evaluate":
            _require_apart(axes)


def _require_apart(axes: Mapping[str, Sequence[Any]]) -> None:
    """Refuse first seeds so near to each other that episodes would count twice."""
    least = max(axes.get("episodes", [USUAL_EPISODES]))
    for one, other in pairwise(sorted(axes.get("seed", []))):
        if other - one < least:
            raise ValueError(
                f"evaluate.seed: found {one} and {other}, expected first seeds {least} apart, the "
                "episodes of a cell: others would count twice"
            )


def _axes(
    kind: str, table: Mapping[str, Any], known: frozenset[str]
) -> Iterator[tuple[str, Sequence[Any]]]:
    """Names of axes and their values."""
    for key, value in table.items():
        if kind == "train" and key == HYPERPARAMETER[:-1] and isinstance(value, dict):
            yield from (
                (HYPERPARAMETER + name, values_of(name, one)) for name, one in value.items()
            )
        else:
            choose(dict.fromkeys(known), key, f"{kind}: key")
            yield key, values_of(key, value)
