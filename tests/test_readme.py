"""What the README shows works as shown."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parent.parent / "README.md").read_text()


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
            assert (Path(__file__).parent.parent / target).exists(), target
