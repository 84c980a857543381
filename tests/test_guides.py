"""The guides for the first hour: docs/first-switcher.md and docs/own-reward.md, top to bottom."""

import importlib
import re
import subprocess
import sys

import pytest

from mmwave_env.reward import reward_from
from tests.paths import ROOT

PAGES = ("first-switcher.md", "own-reward.md")
TEXT = {page: (ROOT / "docs" / page).read_text(encoding="utf-8") for page in PAGES}
BLOCKS = {page: re.findall(r"```python\n(.*?)```", text, re.DOTALL) for page, text in TEXT.items()}


def run(page: str, count=r"\g<0>") -> None:
    """All blocks of a page in order, as one program; ``count`` replaces the number of episodes."""
    names: dict[str, object] = {}
    for block in BLOCKS[page]:
        code = re.sub(r"episodes=\d+", count, block)
        exec(compile(code, page, "exec"), names)


def numbers(text: str) -> list[float]:
    """Every number of the tables in a text, in order."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [float(n) for row in rows for n in re.findall(r"-?\d+(?:\.\d+)?", row)]


@pytest.mark.filterwarnings("ignore:speed .* is outside the design window")
@pytest.mark.parametrize("page", PAGES)
def test_every_example_runs(page, capsys):
    run(page, count="episodes=2")
    assert capsys.readouterr().out


@pytest.mark.slow
def test_the_first_switcher_does_as_well_as_shown(capsys):
    run("first-switcher.md")
    made = capsys.readouterr().out.partition("###")[2]
    shown = TEXT["first-switcher.md"].split("<!-- table:")[1].split("<!-- end of table")[0]
    assert numbers(shown) == pytest.approx(numbers(made), rel=0.02, abs=0.002)
    assert re.sub(r"[-.\d]", "", shown.partition("###")[2]).split() == (
        re.sub(r"[-.\d]", "", made).split()
    )


def test_the_refusal_is_the_one_shown(tmp_path, monkeypatch):
    (hasty,) = (block for block in BLOCKS["own-reward.md"] if "def hasty" in block)
    (tmp_path / "hasty.py").write_text(hasty)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("hasty")
    with pytest.raises(ValueError, match="cannot run on lanes") as refusal:
        reward_from(module.hasty)
    sys.modules.pop("hasty")
    said = str(refusal.value).replace(str(tmp_path / "hasty.py"), "hasty.py")
    assert said in TEXT["own-reward.md"]


# --- docs/install.md


@pytest.mark.slow
def test_the_environment_works_beside_folders_of_the_same_names(tmp_path):
    for name in ("policies", "experiments"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").touch()
    code = (
        "import sys; sys.path.append(sys.argv[1])  # where the package is installed: last\n"
        "import gymnasium, policies\n"
        "gymnasium.make('mmwave_env:MmWaveLoc-v0').reset(seed=0)\n"
        "from policies import LearnedSwitch"
    )
    command = [sys.executable, "-c", code, str(ROOT)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert "cannot import name 'LearnedSwitch' from 'policies'" in done.stderr.splitlines()[-1]
