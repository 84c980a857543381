"""docs/offline.md: its block runs, and its figures are what its commands print."""

import os
import re
import shlex
import subprocess
import sys

import pytest

from tests.cli import environment, succeed
from tests.paths import ROOT, numbers

pytest.importorskip("minari")

PAGE = ("offline.md", (ROOT / "docs" / "offline.md").read_text(encoding="utf-8"))
(BLOCK,) = re.findall(r"```python\n(.*?)```", PAGE[1], re.DOTALL)
MIXED, _, GUIDED = re.findall(r"^mmwave-loc (collect .*)$", PAGE[1], re.MULTILINE)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the page's commands write."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path


def shown(name):
    """What the page shows of a command."""
    return re.search(rf"<!-- {name}: .*? -->\n(.*?)<!-- end of {name} -->", PAGE[1], re.DOTALL)[1]


def assert_as_shown(made, name, within):
    """The same words, and numbers as close as other processors make them."""
    page = shown(name)
    assert re.sub(r"[\d.-]+", "", made).split() == re.sub(r"[\d.-]+", "", page).split()
    assert numbers(made) == pytest.approx(numbers(page), abs=within)


def test_the_block_runs_as_shown(folder, capsys):
    succeed(*shlex.split(MIXED.replace("200", "2")), "--episode-steps", 20, cwd=folder)
    exec(compile(BLOCK, *PAGE[:1], "exec"), {})
    assert 0.0 < float(capsys.readouterr().out) < 20.0


@pytest.mark.slow
def test_the_data_set_is_what_the_page_shows(folder):
    made = succeed(*shlex.split(MIXED), cwd=folder)
    assert_as_shown(made.partition("\nwritten")[0], "collect", 1.0)
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert int(re.search(r"(\d+) MB in one HDF5 file", PAGE[1])[1]) == pytest.approx(
        size / 1e6, abs=2
    )


@pytest.mark.slow
@pytest.mark.torch
def test_the_clone_earns_what_the_page_shows(folder):
    succeed(*shlex.split(GUIDED), cwd=folder)
    script = ROOT / "examples" / "behavior_cloning.py"
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(script)], env=environment() | os.environ,
        capture_output=True, text=True, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert_as_shown(done.stdout, "cloning", 0.03)
