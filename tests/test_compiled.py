"""What numba compiles does what its Python source says, so that either may run."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from mmwave_env import drawing, kinematics, mobility, replay, simulation, stepping
from mmwave_env.estimator import program
from mmwave_env.radio import RADIOS
from mmwave_env.scene import SCENES
from mmwave_env.simulation import SimulatedSource


@pytest.fixture
def plainly(monkeypatch: pytest.MonkeyPatch):
    """A call that lets sparing functions run as plain Python from then on."""

    def begin() -> None:
        for function in (program._advance, drawing.simulate, replay._round_trip, stepping._step):
            plain = function.plain
            monkeypatch.setattr(function, "choice", lambda *_, plain=plain: plain)

    return begin


def motion():
    """What `kinematics.motion` compiles, in Python, on the arrays behind the addresses."""

    def change(block, function):
        for lane in np.flatnonzero(block[kinematics.AT.jerk]):  # where somebody travels
            block[:, lane] = function(kinematics.Traveller(*block[:, lane].tolist()))

    def move_on(address, substeps, here):
        block = address._arr
        while substeps > 0:
            change(block, kinematics.move)
            substeps -= 1
            if (block[kinematics.AT.due, :here] > 0.0).any():
                break
        return substeps

    return move_on, lambda address: change(address._arr, kinematics.observe)


@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_episodes_are_the_same_to_the_bit(scenario, plainly):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario)
    rngs = [np.random.default_rng(seed) for seed in (0, 1, 2, 0, 1, 2)]
    compiled = [source.sample(rng) for rng in rngs[:3]]
    plainly()
    plain = [source.sample(rng) for rng in rngs[3:]]
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(a.table(), b.table())
        np.testing.assert_array_equal(a.site(), b.site())
    assert [rng.random() for rng in rngs[:3]] == [rng.random() for rng in rngs[3:]]


def test_environments_are_the_same_to_the_bit(plainly):
    def run():
        envs = gym.make_vec("MmWaveLoc-v0", num_envs=9, episode_steps=12)
        found = [envs.reset(seed=0)]
        found += [envs.step(np.arange(9) % 2) for _ in range(14)]
        return found

    compiled = run()
    plainly()
    assert data_equivalence(run(), compiled, exact=True)


@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_motion_on_lanes_is_motion_on_floats(scenario, plainly, monkeypatch):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    compiled = source.sample(np.random.default_rng(0))
    plainly()
    monkeypatch.setattr(simulation, "motion", motion)
    on_floats = source.sample(np.random.default_rng(0))
    for field in ("truth_position_m", "truth_velocity_mps", "measurement", "snr_db"):
        np.testing.assert_allclose(
            getattr(on_floats, field), getattr(compiled, field), rtol=1e-9, atol=1e-9
        )
    np.testing.assert_array_equal(on_floats.visible, compiled.visible)
