"""The example of docs/raytrace.md runs, on paths with Sionna's arrays."""

import re

import gymnasium as gym
import numpy as np

from tests.episodes.raytracing.stand_in.sionna.rt import canyon_paths
from tests.paths import ROOT

PAGE = (ROOT / "docs" / "raytrace.md").read_text(encoding="utf-8")


def test_the_recording_of_the_example_is_played():
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    way = np.column_stack([np.linspace(-30.0, 20.0, 60), *np.full((2, 60), 1.5)])
    names = {"paths": canyon_paths(np.array([[-5.0, 4.0, 6.0]]), way)}
    exec(compile(block, "raytrace.md", "exec"), names)
    recording = names["recording"]
    assert "episodes=recording)` plays it" in PAGE
    env = gym.make("mmwave_env:MmWaveLoc-v0", episodes=recording)
    env.reset(seed=0)
    _, reward, *_ = env.step(0)
    assert np.isfinite(reward) and len(recording) == 60


def test_the_waypoints_shown_are_those_of_the_recording():
    (shown,) = re.findall(r"```csv\n(.*?)```", PAGE, re.DOTALL)
    file = ROOT / "mmwave_env" / "data" / "deepmimo_canyon28" / "canyon28_stop_and_go.csv"
    assert shown == file.read_text(encoding="utf-8")
