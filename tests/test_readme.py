"""What the README shows works as shown."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli import succeed
from tests.paths import ROOT

README = (ROOT / "README.md").read_text()


@pytest.mark.torch
def test_training_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("stable_baselines3")
    (example,) = re.findall(r"```python\n(import gymnasium.*?)```", README, re.DOTALL)
    short, count = re.subn(r"total_timesteps=[\d_]+", "total_timesteps=2_000", example)
    assert count == 1
    exec(compile(short, "README.md", "exec"), {})
    ate_m, mean_nees = (float(word) for word in capsys.readouterr().out.split())
    assert 0.1 < ate_m < 100.0
    assert mean_nees > 0.0


def test_links_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if "://" not in target:
            assert (ROOT / target).exists(), target


def numbers(text: str) -> list[float]:
    """Every number of the tables in a text, in order."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [float(n) for row in rows for n in re.findall(r"-?\d+(?:\.\d+)?", row)]


def test_localizing_the_sample_prints_what_is_shown(tmp_path: Path) -> None:
    (command,) = re.findall(r"```\nmmwave-loc (localize .*?)\n```", README, re.DOTALL)
    words = shlex.split(command.replace("\\\n", " "))
    for name in ("track.tum", "track.png"):
        words[words.index(name)] = str(tmp_path / name)
    made = succeed(*words)
    shown = README.split("<!-- localize:")[1].split("-->\n", 1)[1].split("<!-- end of localize")[0]
    made = made.split("Written:")[0]
    assert re.sub(r"\d", "", made).split() == re.sub(r"\d", "", shown).split()
    assert numbers(shown) == pytest.approx(numbers(made), abs=0.002)
    assert (tmp_path / "track.png").exists()


def test_speeds_are_those_of_the_page() -> None:
    """To the two digits that "about" promises."""
    page = (ROOT / "docs" / "performance.md").read_text()
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


@pytest.mark.slow
def test_tables_are_those_of_the_demo(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "experiments.demo", "--out", str(tmp_path)]
    subprocess.run(command, check=True, capture_output=True, cwd=ROOT)
    made = (tmp_path / "tables.md").read_text()
    shown = README.split("<!-- tables:")[1].split("<!-- end of tables")[0]
    assert [line for line in shown.splitlines() if line.startswith("###")] == [
        line for line in made.splitlines() if line.startswith("###")
    ]
    # Another processor rounds otherwise, which a chaotic track can blow up to a few units of
    # the last digit shown; anything that changes an episode or a filter moves far more.
    assert numbers(shown) == pytest.approx(numbers(made), rel=0.02, abs=0.002)
