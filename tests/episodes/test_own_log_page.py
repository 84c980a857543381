"""docs/own-log.md, from top to bottom, as a new user types it."""

import re
import shlex

import pytest

from tests.cli import command
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "own-log.md").read_text("utf-8")
BLOCKS = re.findall(r"^```(python)?\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


@pytest.mark.slow
@pytest.mark.torch
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    names, told = {}, ""
    for language, block in BLOCKS:
        if language:  # "```python" blocks share their names, as in one session
            exec(compile(block, "own-log.md", "exec"), names)
            continue
        for line in block.splitlines():
            done = command(*shlex.split(line)[1:], cwd=tmp_path)
            assert done.returncode == 0 and not done.stderr, done.stderr
            told += done.stdout
    rows = re.findall(r"^\| ([\w-]+) \| -", told, re.MULTILINE)
    assert rows[:4] == ["fixed-ukf", "speed-rule", "imm", "ppo"]
    printed = capsys.readouterr().out
    assert re.match(r"\d+\.\d m off\n", printed) and "### walk, standard, 20 epis" in printed
    assert "| mine | -" in printed
    assert names["track"].visible[:, :2].all() and names["recording"].visible.all()
    assert names["info"]["episode_name"] == "traced walk"
