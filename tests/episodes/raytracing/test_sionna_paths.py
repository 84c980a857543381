"""Sionna's arrays become paths and recordings."""

import numpy as np
import pytest

from mmwave_env.episodes.raytracing.sionna_paths import paths_from_sionna, recording_from_sionna
from mmwave_env.models.measurement import SPEED_OF_LIGHT, Layout
from mmwave_env.models.scene import Scene, Wall
from tests.episodes.raytracing.stand_in.sionna.rt import WALLS_M, canyon_paths
from tests.filters.tracks import geometry

GNB = np.array([[-5.0, 4.0, 6.0]])
TIME = 0.1 * np.arange(60)
VELOCITY = np.tile([9.0, 0.3, 0.0], (60, 1))
WAY = np.array([-44.0, -2.0, 1.5]) + TIME[:, None] * VELOCITY
SCENE = Scene("canyon", (-5.0, 4.0, 6.0), tuple(Wall((0, 1), y) for y in WALLS_M))


def test_a_recording_has_the_geometry_of_the_paths():
    made = recording_from_sionna(canyon_paths(GNB, WAY), TIME, 28e9, VELOCITY, name="ride")
    np.testing.assert_allclose(made.anchors_m, SCENE.anchors_m, atol=1e-4)
    east = WAY[:, 0] > -40.0
    np.testing.assert_array_equal(made.visible.T, [east | True, east | True, east, east | True])
    exact = geometry(WAY, VELOCITY, SCENE, Layout(3))
    shown = np.repeat(made.visible, [4, 4, 4, 1], axis=1)
    off = np.abs(made.measurement - exact)[shown]
    assert off.max() < 1e-4
    np.testing.assert_allclose(
        made.path_gain_db[:, 0], -20.0 * np.log10(1e3 * exact[:, 0]), atol=1e-5
    )
    assert (made.name, made.carrier_hz) == ("ride", 28e9)
    np.testing.assert_array_equal(made.time_s, TIME)
    np.testing.assert_array_equal(made.velocity_mps, VELOCITY)


def test_velocities_are_differences_of_positions_where_none_are_given():
    made = recording_from_sionna(canyon_paths(GNB, WAY), TIME, 28e9)
    np.testing.assert_allclose(made.velocity_mps, VELOCITY, atol=1e-9)


def test_several_transmitters_are_the_anchors():
    stations = np.vstack([GNB, [[30.0, 5.0, 8.0]]])
    made = recording_from_sionna(canyon_paths(stations, WAY), TIME, 28e9, VELOCITY)
    assert sorted(made.anchors_m[:, 0].tolist()) == [-5.0, 30.0]


def test_the_strongest_path_comes_first_and_what_is_none_is_no_number():
    station = paths_from_sionna(canyon_paths(GNB, WAY), 28e9).stations[0]
    np.testing.assert_array_equal(station.interactions[0], [0.0, 1.0, np.nan])
    np.testing.assert_array_equal(station.interactions[-1], [0.0, 1.0, 1.0])
    assert (np.diff(station.gain_db[-1]) < 0.0).all()
    for array in (station.gain_db, station.delay_s, station.phase_rad, station.arrival[..., 0]):
        np.testing.assert_array_equal(np.isnan(array), np.isnan(station.interactions))
    np.testing.assert_array_equal(np.isnan(station.bounce_m[..., 0]), station.interactions != 1.0)
    np.testing.assert_allclose(station.phase_rad[-1], [0.0, np.pi, np.pi])


@pytest.mark.parametrize(
    ("sequence", "digits"),
    [((0, 0), 0.0), ((1, 0), 1.0), ((1, 1), 11.0), ((2, 0), 3.0), ((4, 1), 41.0), ((8, 4), 24.0),
     ((16, 0), 9.0)],
)  # fmt: skip
def test_interactions_are_written_in_the_digits_of_deepmimo(sequence, digits):
    found = canyon_paths(GNB, WAY[:1])
    found.interactions = np.zeros((2, 1, 1, 3), np.uint32)
    found.interactions[:, 0, 0, 2] = sequence
    found.vertices = np.repeat(found.vertices, 2, axis=0)
    station = paths_from_sionna(found, 28e9).stations[0]
    assert station.interactions[0, 0] == digits  # the line of sight of before is the strongest


def test_receivers_that_nothing_reaches_have_no_paths():
    found = canyon_paths(GNB, WAY)
    found.valid[:], found.tau[:] = False, -1.0
    (station,) = paths_from_sionna(found, 28e9).stations
    assert station.interactions.shape == (60, 0)
    with pytest.raises(ValueError, match="sionna: inter: found no line-of-sight path"):
        recording_from_sionna(found, TIME, 28e9)


def test_arrays_of_antennas_are_refused():
    found = canyon_paths(GNB, WAY)
    found.tau = found.tau[:, None, :, None]
    with pytest.raises(ValueError, match=r"tau: found shape \(60, 1, 1, 1, 3\).*synthetic_array"):
        paths_from_sionna(found, 28e9)


def test_paths_that_contradict_the_positions_are_refused():
    found = canyon_paths(GNB, WAY)
    found.tau = np.where(found.tau > 0.0, found.tau + 5.0 / SPEED_OF_LIGHT, found.tau)
    with pytest.raises(ValueError, match="delay: found range_m"):
        recording_from_sionna(found, TIME, 28e9)
