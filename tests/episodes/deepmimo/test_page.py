"""docs/deepmimo.md, from top to bottom, as a new user types it."""

import re
import shlex

import numpy as np
import pytest

from tests.cli import command
from tests.episodes.deepmimo.test_along import grid_paths
from tests.episodes.deepmimo.v3_folder import write_static
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "deepmimo.md").read_text("utf-8")
BLOCKS = re.findall(r"^```(python)?\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


@pytest.mark.slow
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names, told = {}, ""
    write_static(tmp_path / "O1_28", grid_paths(), a_file=200)
    (tmp_path / "way.csv").write_text("t,x,y,z\n0,25,-5,1.5\n10,38,-2,1.5\n20,51,1,1.5\n")
    for language, block in BLOCKS:
        if language:  # "```python" blocks share their names, as in one session
            exec(compile(block, "deepmimo.md", "exec"), names)
            continue
        for line in block.splitlines():
            done = command(*shlex.split(line)[1:], cwd=tmp_path)
            assert done.returncode == 0 and not done.stderr, done.stderr
            told += done.stdout
    rows = re.findall(r"^\| ([\w-]+) \| -", told, re.MULTILINE)
    assert rows[:3] == ["fixed-ukf", "speed-rule", "imm"] and rows.count("imm") == 3
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
    assert printed[-1] == "201 epochs from 67 users, 0.000 m from the way at most"
    assert re.search(r"201 epochs from \d\d users; measured 0\.\d+ m from the way", told)
    np.testing.assert_array_equal(names["again"].visible, names["recording"].visible)
