import numpy as np
import pytest

from mmwave_env.episodes.deepmimo.along import record_along
from mmwave_env.episodes.deepmimo.v4_writer import write_v4
from mmwave_env.episodes.deepmimo.writer import paths_of, write_deepmimo
from mmwave_env.episodes.trajectory import Trajectory
from mmwave_env.models.measurement import Layout
from mmwave_env.models.scene import SCENES
from tests.episodes.deepmimo.scenarios import dynamic_twin, shortened
from tests.episodes.deepmimo.test_writer import recording
from tests.episodes.deepmimo.v3_folder import write_static
from tests.filters.tracks import geometry

STREET = SCENES["street"]


def grid_paths(step=1.0, scene=STREET):
    """Users between (20, -8) and (70, 8); those beyond x = 50 m have no line of sight."""
    x, y = np.arange(20, 70, step), np.arange(-8, 8 + step, step)
    users = np.stack(np.meshgrid(x, y, [1.5]), axis=-1).reshape(-1, 3)
    visible = np.ones((len(users), len(scene.anchors_m)), bool)
    visible[users[:, 0] > 50, 0] = False
    return paths_of(recording(scene, users, np.zeros_like(users), visible))[0]


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    folder, paths = tmp_path_factory.mktemp("grid"), grid_paths()
    write_v4(folder, paths, np.arange(len(paths.position_m)), 0.0 * paths.position_m, {})
    (folder / "trajectory.csv").unlink()  # a grid is no way
    return folder


def walk(seconds=30.0, start=(25.0, -6.5, 1.5), velocity=(1.3, 0.35, 0.0)):
    time = np.linspace(0.0, seconds, 31)
    velocity = np.tile(velocity, (31, 1))
    return Trajectory("walk", time, np.array(start) + time[:, None] * velocity, velocity)


@pytest.mark.parametrize("interpolate", [False, True])
def test_links_are_those_at_the_true_positions(grid, interpolate):
    way = walk()
    recorded, users, error = record_along(grid, way, 0.1, interpolate)
    wanted = way.resampled(0.1)
    np.testing.assert_allclose(recorded.time_s, 0.1 * np.arange(301))
    np.testing.assert_allclose(recorded.velocity_mps, wanted[:, 3:])
    np.testing.assert_allclose(error, np.linalg.norm(recorded.position_m - wanted[:, :3], axis=1))
    assert error.max() < (1e-6 if interpolate else 0.75)
    assert users < 4 * 60
    for anchor in STREET.anchors_m:
        assert np.linalg.norm(recorded.anchors_m - anchor, axis=1).min() < 1e-3
    scene = recorded.scene  # anchors in the order of the recording
    exact = geometry(recorded.position_m, recorded.velocity_mps, scene, Layout(3))
    rows = np.repeat(recorded.visible, [4, 4, 4, 1], axis=1)
    wrong = recorded.measurement - exact
    wrong[:, recorded.layout.angles] = np.angle(np.exp(1j * wrong[:, recorded.layout.angles]))
    # Between users, what is left is the curvature of the range: a cell over eight distances.
    limits = np.tile([0.02, 0.003, 0.003, 0.003], 3) if interpolate else np.full(12, 2e-4)
    assert (np.abs(wrong)[:, :12] <= limits)[rows[:, :12]].all()
    np.testing.assert_allclose(wrong[:, 12], 0.0, atol=0.01)


def test_a_link_is_there_if_all_users_around_have_it(grid):
    way = walk(start=(45.0, 0.1, 1.5), velocity=(0.4, 0.0, 0.0))
    x = way.resampled(0.1)[:, 0]
    for interpolate, sure, last in ((False, 50.5, 50.5), (True, 49.5, 50.0)):
        recorded = record_along(grid, way, 0.1, interpolate).recording
        assert recorded.visible[x <= sure, 0].all()
        assert not recorded.visible[x > last, 0].any()
        np.testing.assert_array_equal(recorded.visible[:, 3], recorded.visible[:, 0])
        assert recorded.visible[:, 1:3].all()


def test_versions_3_and_4_of_a_grid_give_the_same(grid, tmp_path):
    write_static(tmp_path, grid_paths(), a_file=100)
    four, three = (record_along(folder, walk(), 0.5).recording for folder in (grid, tmp_path))
    np.testing.assert_array_equal(three.visible, four.visible)
    rows = np.repeat(four.visible, [4, 4, 4, 1], axis=1)
    np.testing.assert_allclose(three.measurement[rows], four.measurement[rows], atol=2e-4)


def test_what_was_recorded_is_a_scenario_of_its_own(grid, tmp_path):
    recorded = record_along(grid, walk(), 0.1, interpolate=True).recording
    write_deepmimo(tmp_path, recorded)
    again = record_along(tmp_path, Trajectory("again", recorded.time_s, recorded.position_m), 0.1)
    assert again.error_m.max() < 1e-3


def test_a_way_that_leaves_the_grid_is_refused(grid):
    way = walk(velocity=(1.3, 0.6, 0.0))
    with pytest.raises(ValueError, match=r"walk: found \[.*\] at 25\.7 s, expected a place within"
                       r" 1 m of a user of .*; the nearest is 1\.\d+ m away"):  # fmt: skip
        record_along(grid, way, 0.1)
    record_along(grid, way, 0.1, within_m=5.0)


def test_a_dynamic_scenario_is_no_grid(tmp_path):
    folder = dynamic_twin(shortened(tmp_path / "static", 5), tmp_path / "dynamic")
    with pytest.raises(ValueError, match="found 5 scenes, expected a grid of users"):
        record_along(folder, walk(), 0.1)


@pytest.mark.parametrize("dt_s", [0.0, -1.0, np.nan, np.inf, 30.1, 1e-6])
def test_a_step_that_is_none_is_refused(grid, dt_s):
    with pytest.raises(ValueError, match=r"dt_s: found .*at most 30, as long as walk takes"):
        record_along(grid, walk(), dt_s)


@pytest.mark.parametrize("within_m", [-1.0, np.nan])
def test_a_distance_that_is_none_is_refused(grid, within_m):
    with pytest.raises(ValueError, match="within_m: found .*expected at least 0"):
        record_along(grid, walk(), within_m=within_m)
