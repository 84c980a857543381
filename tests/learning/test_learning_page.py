"""docs/learning.md: its examples run, its tables are those of the recorded trainings."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from experiments.evaluation.runs import Run
from policies import LearnedSwitch, shipped_policies
from tests.paths import ROOT, numbers, shortened

PAGE = ROOT / "docs" / "learning.md"
RECORDED = ROOT / "docs" / "learning"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
KINDS = [f"{kind}-{radio}" for kind in ("ppo", "ppo-extended") for radio in ("handset", "standard")]


@pytest.mark.slow  # compiles eight modes
def test_a_shipped_switcher_localizes(capsys):
    (example,) = (one for one in EXAMPLES if "LearnedSwitch" in one)
    exec(compile(example, "learning.md", "exec"), {})
    ate_m, mean_nees = map(float, capsys.readouterr().out.split())
    assert 0.1 < ate_m < 10.0 and 1.0 < mean_nees < 20.0


@pytest.mark.torch
@pytest.mark.filterwarnings("ignore:speed .* is outside the design window")
def test_stable_baselines3_takes_the_native_environment(capsys):
    pytest.importorskip("stable_baselines3")
    (example,) = (one for one in EXAMPLES if "SB3VecEnv" in one)
    found = {}
    exec(compile(shortened(example), "learning.md", "exec"), found)
    assert found["model"].num_timesteps == 4096
    assert "| mine |" in capsys.readouterr().out


def test_a_loop_of_ones_own_steps_into_its_arrays(capsys):
    (example,) = (one for one in EXAMPLES if "out=out" in one)
    found = {}
    exec(compile(example, "learning.md", "exec"), found)
    ended, mean = capsys.readouterr().out.splitlines()
    assert 0.5 < float(re.fullmatch(r"after 200 steps: (\S+) m", ended)[1]) < 20.0
    assert mean == f"mean reward: {found['rewards'].mean()}"
    envs = gym.make_vec("MmWaveLoc-v0", num_envs=64, autoreset_mode="SameStep", reward="paired")
    observations, _ = envs.reset(seed=10_000_000)
    for t in range(3):
        np.testing.assert_array_equal(found["observations"][t], observations)
        observations, rewards, *_ = envs.step(found["actions"][t])
        np.testing.assert_array_equal(found["rewards"][t], rewards)


@pytest.mark.parametrize("kind", KINDS)
def test_the_shipped_switcher_is_the_median_of_its_recorded_run(kind):
    run = Run.read(str(RECORDED / kind))
    assert len(run.seeds) >= 5
    shipped = shipped_policies()[kind]
    assert shipped.read_bytes() == Path(run.policy).read_bytes()
    assert shipped.stat().st_size < 200_000
    manifest = json.loads((RECORDED / kind / "run.json").read_text())
    for seed, path in zip(run.seeds, run.policies, strict=True):
        card = LearnedSwitch(path).card
        assert (card.seed, card.command) == (seed, manifest["command"])
        assert card.command.startswith("mmwave-loc train")
        assert card.evaluation["seed"] >= 5_000_000  # tuning seeds, never test seeds
    rewards = [LearnedSwitch(path).card.evaluation["reward"] for path in run.policies]
    assert rewards == sorted(rewards, reverse=True)
    assert run.median == run.seeds[len(run.seeds) // 2]


def test_the_page_names_the_command_of_every_recorded_run():
    page = PAGE.read_text(encoding="utf-8")
    for kind in KINDS:
        command = json.loads((RECORDED / kind / "run.json").read_text())["command"]
        (shown,) = re.findall(rf"(mmwave-loc train.*) --out runs/{kind}\n", page)
        assert sorted(shown.split()) == sorted(command.split())


@pytest.mark.slow
def test_the_page_is_what_the_command_writes(tmp_path):
    page = tmp_path / "learning.md"
    shutil.copy(PAGE, page)
    command = [sys.executable, "-m", "experiments.learning.learned", "--docs", page]
    subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    made, shown = page.read_text(), PAGE.read_text()
    assert re.sub(r"\d", "", made) == re.sub(r"\d", "", shown)
    # Another processor rounds otherwise; a near tie between two modes answers to that.
    assert np.isclose(numbers(made), numbers(shown), rtol=0.03, atol=0.005).mean() > 0.99
    for name in ("curves", "profiles-handset", "decisions-standard", "trust-handset"):
        assert (tmp_path / "learning" / f"{name}.png").read_bytes().startswith(b"\x89PNG")
