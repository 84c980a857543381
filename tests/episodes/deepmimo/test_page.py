"""docs/deepmimo.md, from top to bottom, as a new user types it."""

import re
import shlex

import pytest

from tests.cli import command
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "deepmimo.md").read_text("utf-8")
BLOCKS = re.findall(r"^```(python)?\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


@pytest.mark.slow
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names, told = {}, ""
    for language, block in BLOCKS:
        if language:  # "```python" blocks share their names, as in one session
            exec(compile(block, "deepmimo.md", "exec"), names)
            continue
        for line in block.splitlines():
            done = command(*shlex.split(line)[1:], cwd=tmp_path)
            assert done.returncode == 0 and not done.stderr, done.stderr
            told += done.stdout
    rows = re.findall(r"^\| ([\w-]+) \| -", told, re.MULTILINE)
    assert rows == ["fixed-ukf", "speed-rule", "imm"]
    assert len(names["recording"].anchors_m) == 2
    printed = capsys.readouterr().out.splitlines()
    assert printed[:2] == [
        "60 epochs, 23.6 s, 5.00 m/s",
        "120 {'line of sight': 120, 'one reflection': 300} 0",
    ]
    assert printed[2:4] == [
        "t000_tx000 base station [-5.0, 4.0, 6.0] 120",
        "t000_tx000 image in the ground [-5.0, 4.0, -6.1] 120",
    ]
