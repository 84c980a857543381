"""Way-points: the way through them keeps to their speeds, stops and limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.episodes.samples import sample_folder
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.episodes.waypoints import WAYPOINT, read_way, read_waypoints, way_through
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES

HEADER = ",".join(WAYPOINT)
ROWS = [[0, 0, 1.5, 10, 2, 0], [100, 0, 1.5, 5, 1, 4], [150, 0, 1.5, 5, 1, 0]]


def write(folder, rows, header=HEADER):
    path = folder / "way.csv"
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def straight(speed, acceleration, wait):
    """A way east of legs of 60 m."""
    n = len(speed)
    position = np.column_stack([60.0 * np.arange(n), np.zeros(n), np.full(n, 1.5)])
    return way_through("east", position, *map(np.array, (speed, acceleration, wait)))


def test_times_are_those_of_constant_acceleration(tmp_path):
    way = read_waypoints(write(tmp_path, ROWS))
    # 75 m at 10 m/s, 5 s down to a stand over 25 m; 4 s of it; 5 s over 12.5 m, 37.5 m at 5 m/s
    assert way.time_s[-1] == pytest.approx(7.5 + 5.0 + 4.0 + 5.0 + 7.5, abs=1e-9)
    rows = way.resampled(0.5)
    np.testing.assert_allclose(rows[15, [0, 3]], [75.0, 10.0], atol=1e-6)
    np.testing.assert_allclose(rows[25:34, :3], [[100.0, 0.0, 1.5]] * 9, atol=1e-6)
    np.testing.assert_allclose(rows[25:34, 3:], 0.0, atol=1e-6)
    np.testing.assert_allclose(rows[-1], [150.0, 0.0, 1.5, 5.0, 0.0, 0.0], atol=1e-6)


LEG = st.tuples(st.floats(0.5, 30.0), st.floats(0.3, 4.0), st.sampled_from([0.0, 0.0, 3.0, 40.0]))


@given(legs=st.lists(LEG, min_size=2, max_size=5))
@settings(max_examples=50, deadline=None)
def test_speed_and_acceleration_keep_to_their_limits(legs):
    speed, acceleration, wait = map(list, zip(*legs, strict=True))
    way = straight(speed, acceleration, wait)
    position, v = way.position_m[:, 0], way.velocity_mps[:, 0]
    on = np.minimum((position / 60.0).astype(int), len(legs) - 2)
    before = np.maximum(np.ceil(position / 60.0).astype(int) - 1, 0)
    assert (v >= 0.0).all() and (v <= np.maximum(*np.array(speed)[[on, before]]) + 0.5).all()
    inside = np.abs((position + 30.0) % 60.0 - 30.0) > 0.2
    assert (v[inside] <= np.array(speed)[on[inside]] + 1e-9).all()
    change = np.abs(np.diff(v)) / np.diff(way.time_s)
    assert (change <= max(acceleration) + 1e-6).all()
    for i, seconds in enumerate(wait):
        standing = way.time_s[np.abs(position - 60.0 * i) < 1e-9]
        assert np.ptp(standing) == pytest.approx(seconds, abs=1e-9)


def test_corners_are_rounded_and_velocities_are_the_derivative():
    corner = np.array([[0.0, 0.0, 1.5], [20.0, 0.0, 1.5], [20.0, 20.0, 1.5]])
    way = way_through("corner", corner, np.full(3, 1.4), np.ones(3), np.zeros(3))
    rows = way.resampled(0.01)
    slope = np.gradient(rows[:, :3], 0.01, axis=0)
    np.testing.assert_allclose(slope[1:-1], rows[1:-1, 3:], atol=0.01)
    off = np.linalg.norm(rows[:, :3] - corner[1], axis=1).min()
    assert 0.5 < off < 1.0  # (r / 4) sqrt(2) from the corner, r = 2 m
    turn = np.abs(np.diff(np.unwrap(np.arctan2(rows[:, 4], rows[:, 3]))))
    assert turn.sum() == pytest.approx(np.pi / 2.0, abs=1e-6) and turn.max() < 0.02


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (1, 3, 0, "line 3, column speed_mps: found 0, expected more than 0, at most 100"),
        (1, 3, 101, "line 3, column speed_mps: found 101, expected more than 0, at most 100"),
        (0, 4, 0, "line 2, column acceleration_mps2: found 0, expected more than 0"),
        (2, 5, -1, "line 4, column wait_s: found -1, expected at least 0"),
        (1, 0, 0.1, "line 3, columns x, y, z: found 0.1, expected at least 0.5 m from the row"),
        (1, 0, "here", "line 3, column x: found 'here', expected a finite number"),
    ],
)
def test_what_nobody_can_go_is_refused_by_line(tmp_path, row, column, value, message):
    rows = [list(row) for row in ROWS]
    rows[row][column] = value
    with pytest.raises(ValueError, match=f"way.csv: {message}"):
        read_waypoints(write(tmp_path, rows))


def test_a_speed_is_enough(tmp_path):
    rows = [[*row[:4], 1.0, 0.0] for row in ROWS]
    way, expected = (
        read_waypoints(write(tmp_path, [row[:n] for row in rows], ",".join(WAYPOINT[:n])))
        for n in (4, 6)
    )
    np.testing.assert_array_equal(way.position_m, expected.position_m)
    np.testing.assert_array_equal(way.time_s, expected.time_s)


def test_one_waypoint_is_no_way(tmp_path):
    with pytest.raises(ValueError, match="rows: found 1, expected at least 2 way-points"):
        read_waypoints(write(tmp_path, ROWS[:1]))


def test_a_file_with_times_is_a_trajectory_and_one_without_has_waypoints(tmp_path):
    timed = read_way(write(tmp_path, [[0, 0, 0, 1.5], [1, 2, 0, 1.5]], "t,x,y,z"))
    np.testing.assert_array_equal(timed.time_s, [0.0, 1.0])
    assert read_way(write(tmp_path, ROWS)).time_s[-1] == pytest.approx(29.0)
    short = ",".join(WAYPOINT[:4])
    with pytest.raises(ValueError, match=f"header: found 'x,y,z', expected .* or {short} of"):
        read_way(write(tmp_path, [[0, 0, 0]], "x,y,z"))


def test_episodes_go_through_waypoints(tmp_path):
    rows = [[20, -80, 1.5, 8, 2, 0], [100, -80, 1.5, 8, 2, 0]]
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], str(write(tmp_path, rows)))
    episode = source.sample(np.random.default_rng(0))
    np.testing.assert_allclose(episode.truth_position_m[:, 0], 20.0 + 8.0 * np.arange(11))


@pytest.mark.parametrize("name", ["canyon28_stop_and_go", "canyon28_walk_ride_walk"])
def test_the_traced_samples_go_through_their_waypoints(name):
    folder = sample_folder(name, "recording")
    way, gone = read_way(folder.with_suffix(".csv")), read_way(folder / "trajectory.csv")
    np.testing.assert_allclose(np.diff(gone.time_s), 0.1)
    rows = np.hstack([gone.position_m, gone.velocity_mps])
    np.testing.assert_allclose(way.resampled(0.1), rows, atol=1e-6)
