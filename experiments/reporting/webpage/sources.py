"""Sources of the web page: files and folders of results that commands wrote."""

from pathlib import Path
from typing import NamedTuple

from experiments.evaluation.runs import curves_of
from mmwave_env.io.files import Json, read_json

READ = "results (--json) of compare, demo or localize, or a folder that train wrote"


class Source(NamedTuple):
    """Results of one command."""

    path: str  # path as the user typed it
    kind: str  # "comparison", "track" or "run"
    content: Json  # content of a file; or a run's summary, with learning curves as "curves"


def read_source(path: Path) -> Source:
    """Read a file of results, or the folder of a finished or unfinished run.

    Raises:
        ValueError: the file does not hold results; the message names the file and what it lacks.
        FileNotFoundError: there is no such file.
    """
    over = path / "summary.json"
    begun = path / "run.json"
    if over.is_file() or begun.is_file():
        if over.is_file():
            run = read_json(over, "the summary of a run", dict)
        else:
            run = read_json(begun, "the manifest of a run", dict)
            outcomes = sorted(path.glob("seed-*/outcome.json"))
            run["seeds"] = [read_json(file, "the outcome of a training", dict) for file in outcomes]
        logs = sorted(path.glob("seed-*/progress.csv"))
        run["curves"] = {file.parent.name: curves_of(file) for file in logs}
        return Source(str(path), "run", run)
    content = read_json(path, "results", dict)
    return Source(str(path), "track" if "groups" in content else "comparison", content)
