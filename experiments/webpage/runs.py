"""Folders of runs of train, whether they are over or not."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.webpage.kinds import RUN, is_number, require_interval
from experiments.webpage.source import Source, read_object, require_keys, told, writer_of

STEP = "timesteps"  # the column of a journal that the others are over


def read_run(path: Path) -> Source:
    """A run that is over, or what there is of one that is not."""
    summary = path / "summary.json"
    over = summary.is_file()
    file = summary if over else path / "run.json"
    content = read_object(file)
    versions = versions_of(path)
    require_keys(str(file), RUN, content, writer_of(versions))
    trainings = sorted(path.glob("seed-*"), key=lambda folder: _number(folder.name))
    if over:
        seeds = content["seeds"]
    else:
        seeds = [read_object(f) for one in trainings if (f := one / "outcome.json").is_file()]
    try:
        for one in seeds:
            check_outcome(one)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: seeds: {told(error)}, expected outcomes of training") from error
    curves = {folder.name: curves_of(folder / "progress.csv") for folder in trainings}
    rest = {"name": str(path), "over": over, "seeds": seeds, "curves": curves}
    return Source(str(path), RUN, content | rest, versions)


def check_outcome(one: Mapping[str, Any]) -> None:
    """Refuse what is no outcome of a training."""
    best, beat = one["best"], one.get("beat_rule")
    for value in (one["seed"], best["reward"], best["timesteps"]):
        if not is_number(value):
            raise ValueError(f"found {value!r}, expected a number")
    for key, gain in best.items():
        if key.startswith("minus "):
            require_interval(key, gain)
    if beat:
        beat["timesteps"], beat["seconds"]


def _number(name: str) -> int:
    digits = name.removeprefix("seed-")
    return int(digits) if digits.isdecimal() else -1


def versions_of(run: Path) -> dict[str, str]:
    """What made a run, as its policy files say it; nothing where there is none yet."""
    from policies import LearnedSwitch

    for policy in sorted(run.glob("seed-*/policy.safetensors")):
        return dict(LearnedSwitch(policy).card.versions)
    return {}


def curves_of(journal: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Steps and values of every figure on tuning seeds in a journal; nothing without one."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    if not journal.is_file():
        return found
    with journal.open(encoding="utf-8", newline="") as lines:
        for number, row in enumerate(csv.DictReader(lines), start=2):
            for name, value in row.items():
                if not (isinstance(name, str) and name.startswith("tuning/") and value):
                    continue
                try:
                    step, figure = float(row[STEP]), float(value)
                except (KeyError, TypeError, ValueError) as error:
                    raise ValueError(
                        f"{journal}: line {number}: {name}: found {value!r}, expected a number "
                        f"over {STEP}"
                    ) from error
                steps, values = found.setdefault(name.removeprefix("tuning/"), ([], []))
                steps.append(step)
                values.append(figure)
    return found
