"""docs/sumo.md, from top to bottom, but for what needs SUMO."""

import re
import shlex

import pytest

from tests.cli import command
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "sumo.md").read_text("utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
SAMPLE = ROOT / "mmwave_env" / "data" / "traffic" / "grid.xml.gz"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sumo")
    (folder / "traffic.xml.gz").write_bytes(SAMPLE.read_bytes())
    ((_, walkers),) = [block for block in BLOCKS if block[0] == "json"]
    (folder / "walkers.json").write_text(walkers)
    return folder


def run(folder, name):
    """The page's command of a name, on two episodes; what it printed."""
    (line,) = re.findall(rf"^mmwave-loc ({name} .*)$", PAGE, re.MULTILINE)
    done = command(*shlex.split(re.sub(r"--episodes \d+", "--episodes 2", line)), cwd=folder)
    assert done.returncode == 0 and not done.stderr, done.stderr
    return done.stdout


def test_a_trip_is_simulated_and_said(folder):
    shown = PAGE.split("<!-- simulate -->\n```\n")[1].split("```")[0]
    assert run(folder, "simulate") == shown


@pytest.mark.slow
def test_policies_are_compared_on_trips(folder):
    assert "### traffic.xml.gz, handset, 2 episodes" in run(folder, "compare")


def test_some_of_the_trips_are_a_scenario(folder):
    assert "### walkers, handset, 2 episodes" in run(folder, "evaluate")


def test_the_python_of_the_page_runs(folder, capsys, monkeypatch):
    """The blocks are marked with "```python"."""
    monkeypatch.chdir(folder)
    ((_, block),) = [block for block in BLOCKS if block[0] == "python"]
    exec(compile(block, "sumo.md", "exec"), {})
    name, about = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"vehicle\d+ of traffic.xml.gz", name)
    assert re.match(r"\d+ of \d+ trips, moved by \(", about)
