"""What numba compiles does what its Python source says, so that either may run."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from mmwave_env.compiler.lazy_jit import LazyJit
from mmwave_env.episodes import kinematics, mobility
from mmwave_env.episodes import simulated as simulation
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES


@pytest.fixture
def go(monkeypatch: pytest.MonkeyPatch):
    """A call that has sparing functions run "compiled" or "plain" from then on."""

    def begin(way: str) -> None:
        def run(function: LazyJit, _: int, *arguments: object) -> object:
            return getattr(function, way)(*arguments)

        monkeypatch.setattr(LazyJit, "__call__", run)
        monkeypatch.setattr(LazyJit, "choice", lambda function, *_: getattr(function, way))

    return begin


def motion():
    """What `kinematics.motion` compiles, in Python, on the arrays behind the addresses."""

    def change(block, function):
        for lane in np.flatnonzero(block[kinematics.AT.jerk]):  # where somebody travels
            block[:, lane] = function(kinematics.Traveler(*block[:, lane].tolist()))

    def move_on(address, substeps, here):
        block = address._arr
        while substeps > 0:
            change(block, kinematics.move)
            substeps -= 1
            if (block[kinematics.AT.due, :here] > 0.0).any():
                break
        return substeps

    return move_on, lambda address: change(address._arr, kinematics.observe)


@pytest.mark.slow  # compiles what draws episodes
@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_episodes_are_the_same_to_the_bit(scenario, go):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario)
    rngs = [np.random.default_rng(seed) for seed in (0, 1, 2, 0, 1, 2)]
    go("compiled")
    compiled = [source.sample(rng) for rng in rngs[:3]]
    go("plain")
    plain = [source.sample(rng) for rng in rngs[3:]]
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a.table(), b.table())
        np.testing.assert_array_equal(a.site(), b.site())
    assert [rng.random() for rng in rngs[:3]] == [rng.random() for rng in rngs[3:]]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_environments_are_the_same_to_the_bit(mode, go):
    def run(way):
        go(way)
        envs = gym.make_vec("MmWaveLoc-v0", num_envs=9, episode_steps=12, autoreset_mode=mode)
        found = [envs.reset(seed=0)]
        found += [envs.step(np.arange(9) % 2) for _ in range(14)]
        return found

    assert data_equivalence(run("plain"), run("compiled"), exact=True)


@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_motion_on_lanes_is_motion_on_floats(scenario, go, monkeypatch):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    go("compiled")
    compiled = source.sample(np.random.default_rng(0))
    go("plain")
    monkeypatch.setattr(simulation, "motion", motion)
    on_floats = source.sample(np.random.default_rng(0))
    for field in ("truth_position_m", "truth_velocity_mps", "measurement", "snr_db"):
        np.testing.assert_allclose(
            getattr(on_floats, field), getattr(compiled, field), rtol=1e-9, atol=1e-9
        )
    np.testing.assert_array_equal(on_floats.visible, compiled.visible)
