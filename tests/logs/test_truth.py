"""Tests of interpolating a true track and estimating the offset between its clock and a log's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from mmwave_env.datasets.samples import sample_folder
from mmwave_env.logs.clock import clock_offset
from mmwave_env.logs.truth import BRIDGED_S, TOLERANCE_S, TrueEpochs, Truth
from mmwave_env.logs.tum import read_tum, tum_lines
from mmwave_env.models.layout import LINK, Layout
from mmwave_env.models.scene import SCENES, read_scene
from tests.logs.by_hand import log_with, read


def truth_of(folder, time_s, position_m):
    path = folder / "truth.tum"
    path.write_text(tum_lines(time_s, position_m))
    return Truth(path)


def expected(pose_s, position, time_s):
    """Return positions and velocities from SciPy's cubic splines; NaN in gaps."""
    p, v = np.full((2, len(time_s), 3), np.nan)
    runs = np.split(np.arange(len(pose_s)), np.flatnonzero(np.diff(pose_s) > BRIDGED_S) + 1)
    for run in runs:
        t = pose_s[run]
        x = position[run]
        away = np.abs(time_s[:, None] - t)
        near = away.min(axis=1) <= TOLERANCE_S
        p[near] = x[away[near].argmin(axis=1)]
        if len(run) > 1:
            curve = CubicHermiteSpline(t, x, np.gradient(x, t, axis=0))
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            p[inside] = curve(time_s[inside])
            v[inside] = curve(time_s[inside], 1)
    return p, v


times = st.lists(st.integers(0, 4000), min_size=1, max_size=60, unique=True)


@settings(max_examples=80, deadline=None)
@given(poses=times, epochs=times, late=st.sampled_from([0.0, 1e-3]))
def test_poses_are_interpolated_but_not_across_gaps(tmp_path_factory, poses, epochs, late):
    pose_s = np.sort(poses) * 1e-2
    time_s = np.sort(epochs) * 1e-2 + late
    position = np.random.default_rng(0).standard_normal((len(pose_s), 3))
    truth = truth_of(tmp_path_factory.mktemp("truth"), pose_s, position)
    positions, velocity, away = truth.at(time_s)
    p, v = expected(pose_s, position, time_s)
    np.testing.assert_allclose(positions, p, atol=1e-9)
    np.testing.assert_allclose(velocity, v, atol=1e-6)
    apart = pose_s - time_s[:, None]
    np.testing.assert_array_equal(
        np.abs(away), np.where(np.isnan(p[:, 0]), np.nan, np.abs(apart).min(axis=1))
    )
    assert (truth.first_s, truth.last_s) == (pose_s[0], pose_s[-1])


STREET = SCENES["street"]


def user(time_s, speed=8.0, sway=4.0):
    """Return positions and velocities of a user who drives at a changing speed."""
    v = np.column_stack([speed + sway * np.sin(0.7 * time_s), 0.5 * np.cos(0.3 * time_s)])
    x = 20.0 + speed * time_s - sway / 0.7 * np.cos(0.7 * time_s)
    p = np.column_stack([x, -40.0 + 0.5 / 0.3 * np.sin(0.3 * time_s)])
    return np.pad(p, [(0, 0), (0, 1)], constant_values=1.5), np.pad(v, [(0, 0), (0, 1)])


def exact_links(position_m, anchors_m):
    """Return the exact rows of all links (T, 4 L), computed in plain NumPy."""
    d = position_m[:, None] - anchors_m
    azimuth = np.arctan2(d[..., 1], d[..., 0])
    flat = np.hypot(d[..., 0], d[..., 1])
    rows = [np.linalg.norm(d, axis=2), azimuth, np.arctan2(d[..., 2], flat), azimuth + np.pi]
    return np.stack(rows, axis=2).reshape(len(d), -1)


def log_of(time_s, position_m, rng, bias=0.0):
    """Return a noisy log of a receiver at given positions; ``bias`` is in standard deviations."""
    sigma = np.tile([0.3, 0.01, 0.01, 0.02], 3)
    z = exact_links(position_m, STREET.anchors_m)
    z = z + sigma * (rng.standard_normal(z.shape) + bias)
    visible = rng.random((len(z), 4)) < 0.8
    return log_with(Layout(3), time_s, np.column_stack([z, np.zeros(len(z))]), visible)


def compared(log, seconds, shift=(0.0, 0.0, 0.0)):
    """Return the estimated clock offset between the true track of :func:`late` and the log."""
    return clock_offset(log, STREET, lambda time_s: late(time_s, seconds, shift))


def late(time_s, seconds, shift=(0.0, 0.0, 0.0)):
    """Return the truth as a track whose times are too late by ``seconds``, moved by ``shift``."""
    p, v = user(time_s - seconds)
    return TrueEpochs(p + shift, v, np.zeros(len(time_s)))


@pytest.mark.parametrize("seconds", [0.0, 0.08, -0.15])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (1.0, -0.6, 0.3)])
def test_an_offset_is_found_despite_biases_and_a_shifted_frame(seconds, shift):
    time_s = np.arange(0.0, 60.0, 0.1)
    log = log_of(time_s, user(time_s)[0], np.random.default_rng(2), bias=0.5)
    clock = compared(log, seconds, shift)
    assert clock.seconds == pytest.approx(seconds, abs=4.0 * clock.deviation_s + 0.01)
    assert 0.0 < clock.deviation_s < 0.01 and clock.matters == bool(seconds)
    if seconds:
        assert f"shift the times in this file by {'-' if seconds > 0.0 else '+'}" in clock.advice


def test_the_standard_error_of_an_offset_is_the_spread_over_many_logs():
    time_s = np.arange(0.0, 40.0, 0.1)
    rng = np.random.default_rng(3)
    clocks = [compared(log_of(time_s, user(time_s)[0], rng), 0.0) for _ in range(60)]
    spread = np.std([clock.seconds for clock in clocks])
    typical = np.median([clock.deviation_s for clock in clocks])
    assert 0.7 * spread < typical < 1.5 * spread
    assert not any(clock.matters for clock in clocks)


def test_the_offset_equals_a_joint_least_squares_fit_of_all_unknowns():
    """Fit the clock's offset, the frame's shift and a bias for every row by NumPy's lstsq."""
    time_s = np.arange(0.0, 30.0, 0.25)
    rng = np.random.default_rng(4)
    log = log_of(time_s, user(time_s)[0], rng)
    truth = late(time_s, 0.05, (0.3, 0.2, 0.0))
    position, velocity, _ = truth

    def links(p):
        return exact_links(p, STREET.anchors_m)

    def wrapped(rows):
        rows = rows.reshape(len(rows), -1, len(LINK))
        rows[..., 1:] = np.remainder(rows[..., 1:] + np.pi, 2.0 * np.pi) - np.pi
        return rows.reshape(len(rows), -1)

    error = wrapped(log.measurement[:, :12] - links(position))
    error[~np.repeat(log.visible[:, :3], 4, axis=1)] = np.nan
    middle = np.nanmedian(error, axis=0)
    sigma = 1.4826 * np.nanmedian(np.abs(error - middle), axis=0)
    slopes = [wrapped(links(position + h) - links(position - h)) / 2e-4 for h in 1e-4 * np.eye(3)]
    columns = [sum(velocity[:, i, None] * slope for i, slope in enumerate(slopes)), *slopes]
    scaled = [column / sigma for column in columns]
    biases = [np.tile(row, (len(time_s), 1)) for row in np.eye(12)]
    used = np.abs(error - middle) <= 6.0 * sigma
    A = np.column_stack([column[used] for column in (*scaled, *biases)])
    expected = np.linalg.lstsq(A, (error / sigma)[used], rcond=None)[0][0]
    assert compared(log, 0.05, (0.3, 0.2, 0.0)).seconds == pytest.approx(expected, rel=1e-4)


def test_a_user_with_constant_velocity_shows_no_offset():
    time_s = np.arange(0.0, 60.0, 0.1)
    velocity = np.tile([5.0, 0.0, 0.0], (len(time_s), 1))
    position = [20.0, -40.0, 1.5] + time_s[:, None] * velocity
    log = log_of(time_s, position, np.random.default_rng(5))

    def truth_at(time_s):
        moved = [20.0, -40.0, 1.5] + (time_s[:, None] - 0.3) * velocity
        return TrueEpochs(moved, velocity, np.zeros(len(time_s)))

    clock = clock_offset(log, STREET, truth_at)
    assert clock is None or not clock.matters


def test_a_short_log_or_an_unknown_ground_truth_gives_no_offset():
    time_s = np.arange(0.0, 8.0, 0.1)
    log = log_of(time_s, user(time_s)[0], np.random.default_rng(7))
    assert compared(log, 0.1) is None
    unknown = np.full((80, 3), np.nan)
    nothing = TrueEpochs(unknown, unknown, unknown[:, 0])
    assert clock_offset(log, STREET, lambda time_s: nothing) is None


@pytest.mark.parametrize("late_s", [-1.0, -0.5, -0.2, 0.2, 0.5, 1.0])
def test_an_offset_is_found_even_if_it_is_too_large_for_one_linearization(tmp_path, late_s):
    folder = sample_folder("canyon28_vehicle")
    path = tmp_path / "truth.tum"
    poses = read_tum(folder / "truth.tum")
    path.write_text(tum_lines(poses.time_s + late_s, poses.position_m))
    scene = read_scene(folder / "scene.json")
    clock = clock_offset(read(folder / "log.csv", scene), scene, Truth(path).at)
    assert clock.matters and clock.seconds == pytest.approx(late_s, abs=0.03)
    assert clock.deviation_s < 0.02
