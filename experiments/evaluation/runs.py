"""Folders that ``mmwave-loc train`` writes, with one policy per training seed."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

from experiments.evaluation.intervals import Interval
from mmwave_env.io.files import first_line, read_json, read_text


def require_outcome(outcome: dict[str, Any]) -> dict[str, Any]:
    """Return the outcome of a training; refuse anything else.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: an entry is missing or wrong.
    """
    best, beat = outcome["best"], outcome.get("beat_rule")
    numbers = [outcome["seed"], outcome["seconds"], best["reward"], best["timesteps"]]
    if beat:
        numbers += [beat["timesteps"], beat["seconds"]]
    for key, gain in best.items():
        if key.startswith("minus "):
            interval = Interval.of(gain)
            numbers += [interval.mean, *((interval.low, interval.high) if gain["ci95"] else ())]
    for value in numbers:
        if not (isinstance(value, int | float) and math.isfinite(value)):
            raise ValueError(f"found {value!r}, expected a number")
    return outcome


@dataclass(frozen=True)
class Run:
    """The trainings of a run, ordered by their reward on tuning seeds, best first."""

    name: str  # the folder, as on the command line and in results
    seeds: tuple[int, ...]  # training seeds, which identify the trainings
    median: int  # seed of the training that stands for the run: the one with the median reward
    # outcome of each training, as the training wrote it
    outcomes: tuple[Mapping[str, Any], ...] = field(default=(), repr=False, compare=False)

    @classmethod
    def read(cls, name: str) -> "Run":
        """Read the run in a folder.

        Raises:
            ValueError: names the file and says what is wrong in it.
            FileNotFoundError: the folder holds no run, or an unfinished one.
        """
        path = Path(name) / "summary.json"
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: found no file, expected the summary of a finished run; "
                "mmwave-loc train --resume continues an unfinished one"
            )
        return read_json(path, "the summary of a run", partial(cls._of, name))

    @classmethod
    def _of(cls, name: str, summary: dict[str, Any]) -> "Run":
        """Return the run that a summary describes."""
        outcomes, median = tuple(summary["seeds"]), summary["median"]
        seeds = tuple(outcome["seed"] for outcome in outcomes)
        numbers = {seed for seed in seeds if type(seed) is int}
        if not seeds or len(numbers) < len(seeds):
            raise ValueError(f"seeds: found {list(seeds)}, expected different numbers")
        if median not in seeds:
            raise ValueError(f"median: found {median!r}, expected one of {list(seeds)}")
        return cls(name, seeds, median, outcomes)

    @property
    def policies(self) -> list[str]:
        """Return the policy file of every training."""
        return [self._policy(seed) for seed in self.seeds]

    @property
    def policy(self) -> str:
        """Return the policy file of the median training."""
        return self._policy(self.median)

    def _policy(self, seed: int) -> str:
        return str(Path(self.name) / f"seed-{seed}" / "policy.safetensors")


def trainings(names: Sequence[str], runs: Mapping[str, Run]) -> list[str]:
    """Return names of contenders, with each run replaced by the policy files of its trainings."""
    return [file for name in names for file in (runs[name].policies if name in runs else [name])]


def curves_of(log: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Read learning curves from a log: for each rival, steps and the reward minus the rival's.

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
