"""Tests that DeepMIMO's own package agrees with our reader; `make deepmimo` runs these tests."""

import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.deepmimo.v4 import open_scenario
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from tests.datasets.deepmimo.scenarios import dynamic_twin, shortened
from tests.paths import RECORDINGS

# DeepMIMO needs numpy below 2.3, and therefore a virtual environment of its own.
deepmimo = pytest.importorskip("deepmimo", reason="make deepmimo runs these tests")

ANGLES = {"aoa": "arrival", "aod": "departure"}


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    """Return the folder in which the package looks for scenarios."""
    monkeypatch.chdir(tmp_path)
    return tmp_path / "deepmimo_scenarios"


def assert_read_alike(theirs, position_m, station):
    """Check that the package and our reader agree about a base station's paths."""
    assert_allclose(theirs.rx_pos, position_m, atol=1e-4)
    assert_allclose(theirs.tx_pos.ravel(), station.position_m, atol=1e-4)
    usual = np.isin(theirs.inter, (0.0, 1.0))  # direct or reflected once: paths that we use
    assert_array_equal(np.argwhere(usual), np.column_stack([station.epoch, station.path]))
    assert_array_equal(theirs.inter[usual], station.is_reflected)
    assert_array_equal(theirs.delay[usual], station.delay_s.astype(np.float32))
    assert_array_equal(theirs.power[usual], station.gain_db.astype(np.float32))
    for key, name in ANGLES.items():
        ours = np.degrees(getattr(station, name))
        assert_allclose(theirs[f"{key}_az"][usual], ours[:, 0], atol=1e-4)
        assert_allclose(theirs[f"{key}_el"][usual], ours[:, 1], atol=1e-4)


def assert_loads(name, shelf):
    """Check that the package loads a scenario as our reader does, and that delays fit distances."""
    deepmimo.summary(name)
    scenario = open_scenario(shelf / name)
    epochs = scenario.epochs(None)
    stations = scenario.paths(epochs)
    positions = scenario.positions(epochs)
    loaded = deepmimo.load(name)
    for theirs, station in zip([loaded] if len(stations) == 1 else loaded, stations, strict=True):
        assert_read_alike(theirs, positions, station)
        sight = theirs.los == 1
        assert_array_equal(np.flatnonzero(sight), station.epoch[~station.is_reflected])
        away = np.linalg.norm(theirs.rx_pos - theirs.tx_pos, axis=1)
        assert_allclose(
            SPEED_OF_LIGHT * theirs.delay[sight, 0].astype(float), away[sight], atol=1e-3
        )
        channel = theirs.compute_channels()
        seen = theirs.num_paths > 0
        assert np.abs(channel[seen]).min() > 0.0 and np.isfinite(channel).all()


@pytest.mark.parametrize("name", ["canyon28_vehicle", "canyon28_pedestrian"])
def test_the_package_loads_shipped_recordings(shelf, name):
    shutil.copytree(RECORDINGS / name, shelf / name)
    assert_loads(name, shelf)


def test_the_package_loads_the_scenes_of_a_dynamic_scenario(shelf):
    folder = dynamic_twin(shortened(shelf / "static", 6), shelf / "dynamic", others=2)
    scenes = deepmimo.load("dynamic")
    ours = open_scenario(folder)
    for scene, theirs in enumerate(scenes):
        rows = np.arange(3)
        epochs = np.column_stack([np.full(3, scene), rows])
        assert_read_alike(theirs, ours.positions(epochs), ours.paths(epochs)[0])
