"""Folders of runs of train, whether they are over or not."""

import csv
from collections.abc import Iterator, Mapping
from io import StringIO
from pathlib import Path

from experiments.evaluation.outcomes import require_outcome
from experiments.webpage.kinds import RUN
from experiments.webpage.source import Source, read_object, require_keys, writer_of
from mmwave_env.files import read_text, told
from mmwave_env.lookup import quoted

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
            require_outcome(one)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file}: seeds: {told(error)}, expected outcomes of training") from error
    curves = {folder.name: curves_of(folder / "progress.csv") for folder in trainings}
    rest = {"name": str(path), "over": over, "seeds": seeds, "curves": curves}
    return Source(str(path), RUN, content | rest, versions)


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
    lines = StringIO(read_text(journal, "a journal of a training"), newline="")
    try:
        for number, row in enumerate(csv.DictReader(lines), start=2):
            for name, step, figure in _figures(f"{journal}: line {number}", row):
                steps, values = found.setdefault(name, ([], []))
                steps.append(step)
                values.append(figure)
    except csv.Error as error:
        raise ValueError(f"{journal}: found no readable CSV ({error}), expected CSV") from error
    return found


def _figures(where: str, row: Mapping[str, str]) -> Iterator[tuple[str, float, float]]:
    """The figures on tuning seeds in a row, with the steps that they are over."""
    for name, value in row.items():
        if not (isinstance(name, str) and name.startswith("tuning/") and value):
            continue
        try:
            yield name.removeprefix("tuning/"), float(row[STEP]), float(value)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{where}: {name:.80}: found {quoted(value)}, expected a number over {STEP}"
            ) from error
