"""The commands that the campaign disturbs: short ones, and what must hold of their files."""

import csv
import io
import json
import pickletools
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from pyarrow import concat_tables, parquet
from safetensors.numpy import load_file

from experiments.sweep import compute
from experiments.sweeping.cell import Cell
from experiments.training.checkpoint import read_checkpoint
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from tests.cli import succeed
from tests.paths import LOGS

KEPT = {".lock": "sweep"}  # hidden files that belong there
NEIGHBOR = {"mine.txt": b"nothing that a command has to do with"}
STREAM = "tfevents"  # a log that TensorBoard reads as far as it is written

SWEEP = """
[evaluate]
policy = ["fixed-ekf", "speed-rule"]
scenario = ["pedestrian", "vehicle"]
episodes = 2
episode_steps = 20

[train]
total_timesteps = 200
episodes = 2
[train.hyperparameters]
num_envs = 4
n_steps = 25
batch_size = 50
hidden = [[8, 8]]
"""


@dataclass(frozen=True)
class Case:
    """A command.

    Attributes:
        words: as typed.
        inputs: files that it reads, by name.
        outputs: files that it writes at the end; none if it is one that goes on with what is there.
        earlier: words added in a run before, whose results may lie there.
        resumed: words that are added where it goes on.
        load: runs in this process what processes of the command run, which then find it compiled.
    """

    words: tuple[str, ...]
    inputs: Mapping[str, bytes] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()
    earlier: tuple[str, ...] = ()
    resumed: tuple[str, ...] = ()
    load: Callable[[], object] = tuple

    def begin(self, folder: Path, before: Mapping[str, bytes]) -> None:
        """Make its folder, with results of before."""
        folder.mkdir()
        for name, content in {**self.inputs, **NEIGHBOR, **before}.items():
            (folder / name).write_bytes(content)

    def typed(self, folder: Path) -> tuple[str, ...]:
        """The words for the folder as it is."""
        there = (folder / "run" / "run.json").exists()
        return (*self.words, *self.resumed) if there else self.words

    def faults(
        self, folder: Path, before: Mapping[str, bytes], reference: Mapping[str, Any]
    ) -> Iterator[str]:
        """What was lost, and what is half-written, if anything.

        Args:
            folder: where the command was ended.
            before: results that lay there.
            reference: results of an undisturbed one.
        """
        for name, content in {**self.inputs, **NEIGHBOR}.items():
            if (folder / name).read_bytes() != content:
                yield f"{name} was changed"
        for path in self._results(folder):
            name = str(path.relative_to(folder))
            if path.read_bytes() == before.get(name):
                continue
            try:
                found = READERS[path.suffix](path)
            except Exception as error:
                yield f"{name} is not whole: {type(error).__name__}: {error}"
                continue
            if self.outputs and found != reference.get(name):
                yield f"{name} is neither that of before nor the new one"
        for name in before:
            if not (folder / name).exists():
                yield f"{name} was lost"

    def results(self, folder: Path) -> dict[str, Any]:
        """All that came out but wall time, by the name of its file; rows of Parquet in one.

        Raises:
            ValueError: a file is not whole.
        """
        files = self._results(folder)
        found = {
            str(path.relative_to(folder)): READERS[path.suffix](path)
            for path in files
            if path.suffix != ".parquet"
        }
        tables = [parquet.read_table(path) for path in files if path.suffix == ".parquet"]
        if tables:
            rows = concat_tables(tables).sort_by(
                [("cell", "ascending"), ("episode_seed", "ascending")]
            )
            found["rows"] = rows.to_pylist()
        return found

    def _results(self, folder: Path) -> list[Path]:
        given = {*self.inputs, *NEIGHBOR}
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        shown = [path for path in files if not path.name.startswith(".")]
        return [path for path in shown if path.name not in given and STREAM not in path.name]


def hidden(folder: Path) -> list[Path]:
    """Files and folders that a command made for a while, and that are still there."""
    found = (path for path in folder.rglob("*") if path.name.startswith((".", "tmp")))
    return [path for path in found if path.name not in KEPT]


# --- the files, by their endings: read whole, without wall time


def _json(path: Path) -> Any:
    return _untimed(json.loads(path.read_text()))


def _untimed(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _untimed(value) for key, value in tree.items() if key != "seconds"}
    return [_untimed(value) for value in tree] if isinstance(tree, list) else tree


def _csv(path: Path) -> Any:
    text = path.read_text()
    header, *rows = csv.reader(io.StringIO(text))
    if not text.endswith("\n") or any(len(row) != len(header) for row in rows):
        raise ValueError("found a row that ends early")
    return [[cell for name, cell in zip(header, row, strict=True) if name != "seconds"]
            for row in (header, *rows)]  # fmt: skip


def _tum(path: Path) -> Any:
    text = path.read_text()
    rows = [list(map(float, line.split())) for line in text.splitlines() if line[0] != "#"]
    if not text.endswith("\n") or any(len(row) != 8 for row in rows):
        raise ValueError("found a row that ends early")
    return text


def _html(path: Path) -> Any:
    text = path.read_text()
    if not text.rstrip().endswith("</html>"):
        raise ValueError("found no end")
    return text


def _zip(path: Path) -> Any:
    with zipfile.ZipFile(path) as archive:
        if archive.testzip() is not None:
            raise ValueError("found a damaged member")
        return sorted(archive.namelist())


def _safetensors(path: Path) -> Any:
    load_file(path)
    return path.read_bytes()


def _checkpoint(path: Path) -> Any:
    return sorted(read_checkpoint(path))


def _pickle(path: Path) -> Any:
    *_, (last, _, _) = pickletools.genops(path.read_bytes())  # which runs nothing
    return last.name  # what it holds is in the policy's file, too


READERS: dict[str, Callable[[Path], Any]] = {
    ".json": _json,
    ".csv": _csv,
    ".tum": _tum,
    ".html": _html,
    ".zip": _zip,
    ".safetensors": _safetensors,
    ".pt": _checkpoint,
    ".pkl": _pickle,
    ".parquet": lambda path: parquet.read_table(path).to_pylist(),
}


# --- the commands


def _log() -> dict[str, bytes]:
    folder = LOGS / "canyon28_vehicle"
    return {name: (folder / name).read_bytes() for name in ("log.csv", "scene.json")}


SMALL: dict[str, Any] = {"num_envs": 4, "n_steps": 25, "batch_size": 50, "hidden": (8, 8)}


def _recipe() -> bytes:
    """A training of four updates, in a second."""
    shipped = read_hyperparameters(shipped_hyperparameters("ppo", "shared"), "ppo")
    return json.dumps(asdict(replace(shipped, **SMALL))).encode()


def _train_here() -> None:
    axes = {f"hyperparameters.{name}": value for name, value in SMALL.items()}
    compute(Cell("train", tuple(sorted((axes | {"total_timesteps": 100}).items()))))


def _compared() -> bytes:
    """What compare writes, for report to show."""
    with tempfile.TemporaryDirectory() as folder:
        succeed(*COMPARE, cwd=folder)
        return (Path(folder) / "c.json").read_bytes()


COMPARE = (
    "compare", "--policies", "fixed-ekf", "speed-rule", "--episodes", "4", "--episode-steps", "30",
    "--json", "c.json", "--episodes-csv", "c.csv",
)  # fmt: skip
CASES: dict[str, Callable[[], Case]] = {
    "train": lambda: Case(
        ("train", "--seeds", "1", "--jobs", "1", "--total-timesteps", "400", "--hyperparameters",
         "mine.json", "--checkpoint-every", "1", "--out", "run"),
        {"mine.json": _recipe()}, resumed=("--resume",), load=_train_here,
    ),
    "compare": lambda: Case(COMPARE, outputs=("c.json", "c.csv"), earlier=("--seed", "7")),
    "localize": lambda: Case(
        ("localize", "log.csv", "--scene", "scene.json", "--speed", "auto", "--out", "t.tum",
         "--json", "t.json"),
        _log(), ("t.tum", "t.csv", "t.json"), earlier=("--no-smoothing",),
    ),
    "report": lambda: Case(
        ("report", "given.json", "--episodes", "2", "--watch", "1", "--out", "page.html"),
        {"given.json": _compared()}, ("page.html",), earlier=("--watch", "0"),
    ),
    "sweep": lambda: Case(
        ("sweep", "grid.toml", "--workers", "1", "--out", "out"), {"grid.toml": SWEEP.encode()},
        load=lambda: (_compared(), _train_here()),
    ),
}  # fmt: skip
