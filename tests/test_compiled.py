"""What numba compiles does what its Python source says."""

from types import ModuleType

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from mmwave_env import generators, mobility, simulation, travel
from mmwave_env.estimator import program
from mmwave_env.radio import RADIOS
from mmwave_env.scene import SCENES
from mmwave_env.simulation import SimulatedSource


def interpret(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> int:
    """Replace a module's compiled functions by their source; how many there were."""
    compiled = {k: v for k, v in vars(module).items() if isinstance(v, Dispatcher)}
    for name, function in compiled.items():
        monkeypatch.setattr(module, name, function.py_func)
    return len(compiled)


def motion():
    """What `travel.motion` compiles, in Python, on the arrays behind the addresses."""

    def change(block, function):
        for lane in np.flatnonzero(block[travel.AT.jerk]):  # where somebody travels
            block[:, lane] = function(travel.Traveller(*block[:, lane].tolist()))

    def move_on(address, substeps, here):
        block = address._arr
        while substeps > 0:
            change(block, travel.move)
            substeps -= 1
            if (block[travel.AT.due, :here] > 0.0).any():
                break
        return substeps

    return move_on, lambda address: change(address._arr, travel.observe)


@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_episode_is_the_same_interpreted(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    compiled = source.sample(np.random.default_rng(0))
    for module in (generators, program, simulation, travel):
        assert interpret(monkeypatch, module) > 0
    monkeypatch.setattr(simulation, "motion", motion)
    interpreted = source.sample(np.random.default_rng(0))
    for field in ("truth_position_m", "truth_velocity_mps", "measurement", "snr_db"):
        np.testing.assert_allclose(
            getattr(interpreted, field), getattr(compiled, field), rtol=1e-9, atol=1e-9
        )
    np.testing.assert_array_equal(interpreted.visible, compiled.visible)
