"""Folders that ``mmwave-loc train`` writes, with one policy per training seed."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path

from experiments.console.tables import grid
from experiments.evaluation.intervals import Interval
from mmwave_env.io.files import Json, first_line, read_json, read_text


@dataclass(frozen=True)
class Run:
    """A run of ``mmwave-loc train``, with one policy per training seed."""

    name: str  # the folder, as on the command line and in results
    seeds: tuple[int, ...]  # training seeds, ordered by reward on tuning seeds, best first
    median: int  # training seed of the policy with the median reward, which represents the run

    @classmethod
    def read(cls, name: str) -> "Run":
        """Read the run in a folder.

        Raises:
            ValueError: the summary is invalid; the message names the file and what is wrong in it.
            FileNotFoundError: the folder holds no finished run.
        """
        path = Path(name) / "summary.json"
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: found no file, expected the summary of a finished run; "
                "mmwave-loc train --resume continues an unfinished run"
            )
        return read_json(path, "the summary of a run", partial(cls._of, name))

    @classmethod
    def _of(cls, name: str, summary: Json) -> "Run":
        """Return the run that a summary describes."""
        seeds = tuple(outcome["seed"] for outcome in summary["seeds"])
        median = summary["median"]
        numbers = {seed for seed in seeds if type(seed) is int}
        if not seeds or len(numbers) < len(seeds):
            raise ValueError(f"seeds: found {list(seeds)}, expected different numbers")
        if median not in seeds:
            raise ValueError(f"median: found {median!r}, expected one of {list(seeds)}")
        return cls(name, seeds, median)

    @property
    def policies(self) -> list[str]:
        """Return the policy file of every training seed."""
        return [self._policy(seed) for seed in self.seeds]

    @property
    def policy(self) -> str:
        """Return the policy file of the median seed."""
        return self._policy(self.median)

    def _policy(self, seed: int) -> str:
        return str(Path(self.name) / f"seed-{seed}" / "policy.safetensors")


def curves_of(log: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Read the learning curves in a log: for each rival, steps and reward minus its reward.

    Raises:
        ValueError: the log is not CSV, or a value is not a number; the message names the line.
    """
    curves: dict[str, tuple[list[float], list[float]]] = {}
    rows = csv.DictReader(StringIO(read_text(log, "the progress log of a training"), newline=""))
    try:
        for row in rows:
            for name, value in row.items():
                if value and name.startswith("tuning/minus "):
                    steps, values = curves.setdefault(name.split(" ", 1)[1], ([], []))
                    steps.append(float(row["timesteps"]))
                    values.append(float(value))
    except (csv.Error, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{log}: line {rows.line_num}: {first_line(error)[:300]}") from error
    return curves


def outcomes_markdown(outcomes: Sequence[Json]) -> str:
    """Return a Markdown table of training outcomes, one row per seed, in the given order."""
    rows = []
    minus = [key for key in outcomes[0]["best"] if key.startswith("minus ")]
    for outcome in outcomes:
        best = outcome["best"]
        gains = [Interval.of(best[name]) for name in minus]
        cells = [outcome["seed"], f"{best['reward']:.4f}", best["timesteps"], *gains]
        rows.append([*cells, f"{outcome['seconds']:g} s"])
    header = ["seed", "reward", "best after", *minus, "time"]
    return grid(header, rows)
