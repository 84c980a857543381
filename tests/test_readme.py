"""What the README shows works as shown, and its figures are those of the commands it names."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.demo import SHOWN
from tests.paths import ROOT, numbers, shortened

README = (ROOT / "README.md").read_text(encoding="utf-8")
RESULTS = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_it_is_read_in_a_minute():
    assert len(README.splitlines()) <= 110
    assert len([line for line in EXAMPLE.splitlines() if line]) <= 16


def test_the_moving_picture_loads_quickly():
    (picture,) = re.findall(r"\]\((docs/\w+\.gif)\)", README)
    assert (ROOT / picture).stat().st_size < 1.5e6


# --- the training example


@pytest.mark.slow
@pytest.mark.torch
@pytest.mark.filterwarnings("ignore:speed .* is outside the design window")
def test_the_training_example_runs(capsys):
    pytest.importorskip("stable_baselines3")
    exec(compile(shortened(EXAMPLE), "README.md", "exec"), {})
    shown = [row.split(" | ")[0] for row in capsys.readouterr().out.splitlines() if "±" in row]
    assert shown == ["| mine", "| fixed-ukf", "| speed-rule", "| imm"]


@pytest.mark.slow
@pytest.mark.torch
def test_the_training_example_learns_something():
    """Three seeds gained 0.046 to 0.061 on fixed-ukf: 0.02 is no matter of luck."""
    pytest.importorskip("stable_baselines3")
    done = subprocess.run(
        [sys.executable, "-c", EXAMPLE],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    policies, paired = done.stdout.split("Paired differences")
    (header,) = re.findall(r"^\| reward of \| (.*) \|$", paired, re.MULTILINE)
    (gains,) = re.findall(r"^\| mine \| (.*) \|$", paired, re.MULTILINE)
    cells = zip(header.split(" | "), gains.split(" | "), strict=True)
    gain = {name: float(cell.split()[0]) for name, cell in cells}
    assert gain["minus fixed-ukf"] >= 0.02, policies
    assert gain["minus speed-rule"] >= 0.02, policies


# --- results


def tables(text: str) -> dict[str, list[str]]:
    """Rows of the policies' tables by the place in their titles."""
    found = {}
    for part in re.split(r"^### ", text, flags=re.MULTILINE)[1:]:
        rows = part.split("Paired differences")[0].splitlines()
        found[part.split(",")[0]] = [row for row in rows if row.startswith("| ")]
    return found


def test_the_table_is_that_of_the_results():
    shown = README.split("<!-- table: six rows")[1].split("<!-- end of table")[0]
    header, *rows = tables(RESULTS)["mixed"]
    picked = [row for row in rows if row.split(" | ")[0][2:] in SHOWN]
    assert [row for row in shown.splitlines() if row.startswith("| ")] == [header, *picked]


@pytest.mark.slow
def test_the_results_are_those_of_the_demo(tmp_path: Path):
    command = [sys.executable, "-m", "experiments.demo", "--out", str(tmp_path)]
    told = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    made = (tmp_path / "tables.md").read_text(encoding="utf-8")
    shown = RESULTS.split("<!-- tables:")[1].split("<!-- end of tables")[0]
    assert [line for line in shown.splitlines() if line.startswith("###")] == [
        line for line in made.splitlines() if line.startswith("###")
    ]
    rows = [[row for row in text.splitlines() if row.startswith("| ")] for text in (shown, made)]
    assert [row.split(" | ")[0] for row in rows[0]] == [row.split(" | ")[0] for row in rows[1]]
    # Another processor rounds otherwise, which a chaotic track can blow up to a few units of
    # the last digit shown; anything that changes an episode or a filter moves far more.
    assert numbers(shown) == pytest.approx(numbers(made), rel=0.02, abs=0.002)
    for place, six in tables(told).items():
        assert [row.split(" | ")[0][2:] for row in six] == ["policy", *SHOWN]
        assert set(six) <= set(tables(made)[place])
    assert str(tmp_path / "tables.md") in told and str(tmp_path / "mixed.json") in told


def test_speeds_are_those_of_the_page():
    """To the two digits that "about" promises."""
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    table = page.split("<!-- table: Ratios -->")[1].split("<!-- end -->")[0]
    (said,) = re.findall(
        r"makes about (\d+) times.*1024 about (\d+) times with one thread and (\d+) times with two",
        README,
        re.DOTALL,
    )
    names = ("single environment", "native, N = 1024, 1 thread", "native, N = 1024")
    for number, name in zip(said, names, strict=True):
        (median,) = re.findall(rf"^\| {name} \| ([\d.,]+) ", table, re.MULTILINE)
        assert float(number) == pytest.approx(float(median.replace(",", "")), rel=0.05), name
