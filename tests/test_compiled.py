"""What numba compiles does what its Python source says."""

from types import ModuleType

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from mmwave_env import mobility, simulation, travel
from mmwave_env.radio import RADIOS
from mmwave_env.scene import SCENES
from mmwave_env.simulation import SimulatedSource


def interpret(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> int:
    """Replace a module's compiled functions by their source; how many there were."""
    compiled = {k: v for k, v in vars(module).items() if isinstance(v, Dispatcher)}
    for name, function in compiled.items():
        monkeypatch.setattr(module, name, function.py_func)
    return len(compiled)


def on_floats(function):
    """A function of numbers as one of a block, of whose lanes only the first is looked at."""

    def run(block):
        block[:, 0] = function(travel.Traveller(*block[:, 0].tolist()))

    return run


@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_episode_is_the_same_interpreted(scenario: str, monkeypatch: pytest.MonkeyPatch) -> None:
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    compiled = source.sample(np.random.default_rng(0))
    assert interpret(monkeypatch, travel) > 0
    assert interpret(monkeypatch, simulation) > 0
    advance = travel.going(on_floats(travel.move))
    slowly = travel.journey(on_floats(travel.observe), advance)
    monkeypatch.setattr(travel, "_on_lanes", lambda: slowly)
    interpreted = source.sample(np.random.default_rng(0))
    for field in ("truth_position_m", "truth_velocity_mps", "measurement", "snr_db"):
        np.testing.assert_allclose(
            getattr(interpreted, field), getattr(compiled, field), rtol=1e-9, atol=1e-9
        )
    np.testing.assert_array_equal(interpreted.visible, compiled.visible)
