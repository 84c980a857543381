"""docs/own-agent.md: every block runs as shown, on fewer episodes."""

import csv
import re
import shlex
import sys

import pytest

from experiments.arguments.compare import Args as compare
from experiments.arguments.evaluate import Args as evaluate
from mmwave_env.metrics import BURN_IN
from tests.cli import command
from tests.paths import ROOT

PAGE = ("own-agent.md", (ROOT / "docs" / "own-agent.md").read_text(encoding="utf-8"))
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE[1], re.DOTALL)
FUNCTION, MODULE, TRAIN, MODES, AGAIN, PAIRED = BLOCKS
LINES = re.findall(r"^mmwave-loc (.*)$", PAGE[1], re.MULTILINE)

pytestmark = pytest.mark.filterwarnings("ignore:speed .* is outside the design window")


def few(text):
    """A block or a command with 2 episodes to test on and 4096 steps to train."""
    text = re.sub(r"(episodes[= ])200", r"\g<1>2", text)
    return text.replace("total_timesteps=200_000", "total_timesteps=4_096")


def shown(line, folder):
    """What a command of the page prints."""
    done = command(*shlex.split(few(line)), cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The current folder, with the page's module in it."""
    (tmp_path / "my_agents.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    sys.modules.pop("my_agents", None)


@pytest.mark.parametrize("told", [PAGE[1], compare.__doc__, evaluate.__doc__])
def test_the_burn_in_is_told(told):
    assert f"the reward too, leave out the first {BURN_IN} epochs of an episode." in told


def test_functions_are_compared(capsys):
    exec(compile(few(FUNCTION), *PAGE[:1], "exec"), {})
    alone, rows = capsys.readouterr().out.split("Paired")[0].split("###")[1:]
    assert "| act | -" in alone and "| fixed-ukf | -" in rows and "| mine | -" in rows


def test_modules_are_compared(folder):
    compared, _ = (line for line in LINES if line.startswith("compare --policies my_agents"))
    assert "| my_agents:make_policy | -" in shown(compared, folder)


def test_the_episode_that_is_lost_most_is_played_again(folder, capsys):
    _, compared = (line for line in LINES if line.startswith("compare --policies my_agents"))
    shown(compared, folder)
    with (folder / "episodes.csv").open() as file:
        table = {(row["policy"], row["key"]): row for row in csv.DictReader(file)}
    found = {}
    exec(compile(AGAIN, *PAGE[:1], "exec"), found)
    *steps, last = capsys.readouterr().out.splitlines()
    assert len(steps) == 200
    told = float(last.removeprefix("mean position error, m: "))
    assert told == pytest.approx(float(table["my_agents:make_policy", found["key"]]["ate_m"]))


@pytest.mark.slow
def test_agents_of_other_modes_are_compared(folder, capsys):
    exec(compile(few(MODES), *PAGE[:1], "exec"), {})
    assert "| mine | -" in capsys.readouterr().out
    (evaluated,) = (line for line in LINES if "ukf-robust" in line)
    assert "| my_agents:make_policy | -" in shown(evaluated, folder)


@pytest.mark.slow
@pytest.mark.torch
def test_models_are_trained_saved_converted_and_compared(folder):
    pytest.importorskip("stable_baselines3")
    names = {}
    exec(compile(few(TRAIN), *PAGE[:1], "exec"), names)
    converted, compared, trusted = (line for line in LINES if "my_agents" not in line)
    assert "on 1000 of 1000 observations" in shown(converted, folder)
    assert "| policy.safetensors | -" in shown(compared, folder)
    names["PPO"]("MlpPolicy", names["envs"].venv).save("plain.zip")
    assert "| plain.zip | -" in shown(trusted, folder)


def test_the_paired_reward_is_paid(capsys):
    exec(compile(PAIRED, *PAGE[:1], "exec"), {})
    assert abs(float(capsys.readouterr().out)) < 10.6
