"""Tests of episodes: geometry, layout, refused values, and tables, which engines read."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.filters.textbook import Sensor
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import blank_incoming
from tests.filters.tracks import drawn, geometry
from tests.refusals import refuses


@pytest.fixture(scope="module")
def episode():
    return drawn(0)


# --- geometry


@pytest.mark.parametrize("scene", SCENES)
def test_geometry_equals_the_textbook(scene):
    scene = SCENES[scene]
    rng = np.random.default_rng(0)
    position = rng.uniform(-200.0, 200.0, (500, 3))
    velocity = rng.normal(0.0, 5.0, (500, 3))
    rows = geometry(position, velocity, scene, Layout())
    sensor = Sensor(scene.anchors_m, scene.hz_per_mps)
    expected = [sensor.h(state) for state in np.hstack([position, velocity, np.zeros((500, 1))])]
    assert_allclose(sensor.difference(rows, expected), 0.0, atol=1e-9)
    assert np.abs(rows[:, sensor.angles]).max() <= np.pi


def test_odometry_rows_are_speed_and_heading():
    velocity = np.array([[3.0, 4.0, 0.0], [-1.0, 0.0, 0.0]])
    z = geometry(np.zeros((2, 3)), velocity, SCENES["street"], Layout(odometry=True))
    assert_allclose(z[:, 13:], [[5.0, np.arctan2(4.0, 3.0)], [1.0, np.pi]])


def test_angles_are_wrapped():
    for seed in range(20):
        episode = drawn(seed, odometry=True)
        assert np.abs(episode.measurement[:, episode.layout.angles]).max() <= np.pi


# --- values that are missing, and values that are refused


@pytest.mark.parametrize(
    ("field", "row", "group", "value"),
    [
        ("measurement", 4, 1, np.inf),
        ("measurement", 11, 2, -np.inf),
        ("measurement", 12, 3, np.nan),
        ("sigma", 8, 2, np.inf),
    ],
)
def test_measurements_with_a_nonfinite_value_or_sigma_are_missing_and_counted(
    episode, field, row, group, value
):
    t = int(np.flatnonzero(episode.visible[:, group])[0])
    values = getattr(episode, field).copy()
    values[t, row] = value
    damaged = replace(episode, **{field: values})
    assert damaged.nonfinite == 1
    expected = episode.visible.copy()
    expected[t, group] = False
    assert_array_equal(damaged.usable, expected)
    assert np.isfinite(damaged.table()).all()


def test_a_missing_measurement_that_is_not_finite_is_not_counted(episode):
    visible = episode.visible.copy()
    visible[3] = False
    measurement = episode.measurement.copy()
    measurement[3] = np.nan
    blind = replace(episode, visible=visible, measurement=measurement)
    assert blind.nonfinite == 0 and np.isfinite(blind.table()).all()


DAMAGE = {
    "scene_anchors_m": lambda v: v[:2],
    "measurement": lambda v: v[:, :5],
    "sigma": lambda v: 0.0 * v,
    "visible": lambda v: v[:-1],
    "snr_db": lambda v: v[:, :1],
    "doppler_spread_hz": lambda v: v[:, None],
    "prior_mean": lambda v: v * np.nan,
    "prior_covariance": lambda v: -v,
    "truth_position_m": lambda v: v[:, :2],
    "truth_velocity_mps": lambda v: v.T,
    "time_s": lambda v: v[::-1],
}


@pytest.mark.parametrize("field", DAMAGE)
def test_a_wrong_field_is_refused_with_the_names_of_field_and_episode(episode, field):
    """Check also that NaN is refused in fields whose values may not be missing."""
    wrong = [DAMAGE[field](getattr(episode, field))]
    if field not in ("measurement", "visible", "snr_db"):
        wrong.append(getattr(episode, field).copy())
        wrong[1].flat[1] = np.nan
    for value in wrong:
        with refuses(field, "episode 'cyclist'"):
            replace(episode, **{field: value})


# --- the table that engines read, with one row per epoch


def test_an_engine_reads_the_episode_from_the_table():
    episode = drawn(1, odometry=True)
    table = episode.table()
    template = blank_incoming(episode.layout)
    assert len(table) == len(episode)
    for t in (0, 1, 77, 199):
        incoming = unflatten(template, iter(table[t].tolist()))
        epoch = incoming.epoch(episode.layout)
        rows = np.repeat(episode.visible[t], episode.layout.widths)
        assert_array_equal(np.array(epoch.z)[rows], episode.measurement[t, rows])
        assert_array_equal(np.array(epoch.sigma)[rows], episode.sigma[t, rows])
        assert_array_equal(epoch.visible, episode.visible[t])
        links = episode.visible[t, :3]
        assert_array_equal(np.array(epoch.snr_db)[links], episode.snr_db[t, links])
        assert epoch.dt == (0.0 if t == 0 else episode.time_s[t] - episode.time_s[t - 1])
        assert epoch.doppler_spread_hz == episode.doppler_spread_hz[t]
        state = [*episode.truth_position_m[t], *episode.truth_velocity_mps[t]]
        assert_array_equal(incoming.truth, state)


def test_the_table_of_an_episode_without_truth_has_nan_instead_of_the_truth(episode):
    unknown = replace(episode, truth_position_m=None, truth_velocity_mps=None)
    table = unknown.table()
    assert np.isnan(table[:, -6:]).all() and np.isfinite(table[:, :-6]).all()
