"""The ray tracer's process: what it finds, and what is said where it can't run."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mmwave_env.episodes.deepmimo.recording import recording_of
from mmwave_env.episodes.raytracing.child import BLOCK
from mmwave_env.episodes.raytracing.tracing import CANYON, RayTracerError, trace_rays
from mmwave_env.episodes.tables import TRAJECTORY, read_table
from mmwave_env.lookup import MissingExtraError
from tests.episodes.raytracing.stand_in.sionna.rt import canyon_paths
from tests.paths import RECORDINGS

STAND_IN = Path(__file__).parent / "stand_in"
TRACED = ("canyon28_stop_and_go", "canyon28_walk_ride_walk")
WAY = np.column_stack([np.linspace(-45.0, 40.0, BLOCK + 30), *np.full((2, BLOCK + 30), 1.5)])


@pytest.fixture
def stand_in(monkeypatch):
    """Sionna RT is what the folder beside this file has of it."""
    monkeypatch.syspath_prepend(STAND_IN)


def test_paths_come_back_from_the_process_block_by_block(stand_in):
    shares = []
    found = trace_rays(CANYON, WAY, progress=shares.append)
    assert shares == sorted(shares) and shares[-2:] == [BLOCK / len(WAY), 1.0]
    (station,) = found.stations
    np.testing.assert_array_equal(found.position_m, WAY)
    np.testing.assert_array_equal(station.position_m, CANYON.base_station_m)
    expected = canyon_paths(np.array([CANYON.base_station_m]), WAY)
    np.testing.assert_allclose(station.delay_s[:, 0], expected.tau[:, 0, 2], rtol=1e-6)
    made = recording_of(found, 0.1 * np.arange(len(WAY)), np.zeros_like(WAY))
    assert made.visible.sum(axis=0).tolist() == [230, 230, (WAY[:, 0] > -40.0).sum(), 230]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("missing", "found no usable LLVM with DRJIT_LIBLLVM_PATH=/lib/none.so .jit_find_library.*"
         "expected libLLVM 19 or newer .*apt-get install libllvm19, or DRJIT_LIBLLVM_PATH="),
        ("abort", r"found LLVM 15.0.6 \(.*\), with which it ended by SIGABRT \(LLVM ERROR: Cannot "
         "select: fmaximum.*expected libLLVM 19 or newer"),
        ("fail", "found that it ended with code 1: MemoryError: too many rays$"),
    ],
)  # fmt: skip
def test_a_tracer_that_cant_run_says_what_was_found_and_what_is_needed(
    stand_in, monkeypatch, how, message
):
    monkeypatch.setenv("STAND_IN", how)
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/lib/none.so")
    with pytest.raises(RayTracerError, match=message) as error:
        trace_rays(CANYON, WAY[:3])
    assert isinstance(error.value, ValueError) and "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        ("canyon", "geometry: found 'canyon', expected one of simple_.*canyon, box, or an .xml"),
        (
            "here.xml",
            r"here.xml: found what Sionna can't load \(no such file: here.xml\), expected",
        ),
    ],
)
def test_a_geometry_that_is_none_is_refused(stand_in, geometry, message):
    with pytest.raises(ValueError, match=message):
        trace_rays(CANYON, WAY[:3], geometry)


def test_without_sionna_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sionna", None)
    with pytest.raises(MissingExtraError, match=r"needs sionna: .*'mmwave-loc\[raytrace\]'"):
        trace_rays(CANYON, WAY)


# --- the ray tracer itself, and what comes along of it


@pytest.mark.slow
@pytest.mark.parametrize("name", TRACED)
def test_the_samples_are_what_the_ray_tracer_finds(name):
    pytest.importorskip("sionna", reason="needs the extra raytrace")
    _, rows = read_table(RECORDINGS / name / "trajectory.csv", TRAJECTORY)
    some = rows[::7]
    (station,) = trace_rays(CANYON, some[:, 1:4]).stations

    def shipped(key):
        with np.load(RECORDINGS / name / f"{key}_t000_tx000_r001.npz") as file:
            return file[key].astype(float)[::7, : station.interactions.shape[1]]

    np.testing.assert_array_equal(shipped("inter"), station.interactions)
    np.testing.assert_allclose(shipped("delay"), station.delay_s, atol=1e-13)  # s: 0.03 mm
    np.testing.assert_allclose(shipped("power"), station.gain_db, atol=0.01)
    np.testing.assert_allclose(shipped("inter_pos")[:, :, 0], station.bounce_m, atol=1e-3)
    for key, angle in (("aoa", station.arrival), ("aod", station.departure)):
        for i, axis in enumerate(("az", "el")):
            off = np.radians(shipped(f"{key}_{axis}")) - angle[..., i]
            assert np.nanmax(np.abs(np.remainder(off + np.pi, 2.0 * np.pi) - np.pi)) < 1e-5
