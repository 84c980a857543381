"""Tests of episodes: geometry, layout, refused values, and tables, which engines read."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.world.episode import blank_incoming
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import geometry, sampled
from tests.refusals import refuses

STREET = SCENES["street"]
HZ_PER_MPS = 28e9 / 299_792_458.0


def draw(seed=0, scene=STREET, radio=RADIOS["handset"], **changes):
    return sampled(SimulatedSource(scene, radio, **changes), seed)


@pytest.fixture(scope="module")
def episode():
    return draw()


def wrapped(angle):
    return np.angle(np.exp(1j * angle))


def exact(position, velocity, anchors):
    """Return the exact measurements (T, rows) of a user.

    The rows are range, azimuth of arrival, elevation and azimuth of departure of each link, then
    the Doppler shift.
    """
    columns = []
    for anchor in anchors:
        away = position - anchor
        ground = np.hypot(away[:, 0], away[:, 1])
        bearing = np.angle(away[:, 0] + 1j * away[:, 1])
        departure = np.angle(-away[:, 0] - 1j * away[:, 1])
        columns += [np.sqrt(ground**2 + away[:, 2] ** 2), bearing]
        columns += [np.arctan(away[:, 2] / ground), departure]
    away = position - anchors[0]
    unit = away / np.linalg.norm(away, axis=1, keepdims=True)
    columns.append(HZ_PER_MPS * (unit * velocity).sum(axis=1))
    return np.column_stack(columns)


# --- geometry


@pytest.mark.parametrize("scene", SCENES)
def test_geometry_equals_an_independent_implementation(scene):
    scene = SCENES[scene]
    rng = np.random.default_rng(0)
    position = rng.uniform(-200.0, 200.0, (500, 3))
    velocity = rng.normal(0.0, 5.0, (500, 3))
    rows = geometry(position, velocity, scene, Layout())
    angles = Layout().angles
    difference = rows - exact(position, velocity, scene.anchors_m)
    difference[:, angles] = wrapped(difference[:, angles])
    assert_allclose(difference, 0.0, atol=1e-9)
    assert np.abs(rows[:, angles]).max() <= np.pi


def test_odometry_rows_are_speed_and_heading():
    velocity = np.array([[3.0, 4.0, 0.0], [-1.0, 0.0, 0.0]])
    z = geometry(np.zeros((2, 3)), velocity, STREET, Layout(odometry=True))
    assert_allclose(z[:, 13:], [[5.0, np.arctan2(4.0, 3.0)], [1.0, np.pi]])


def test_angles_are_wrapped():
    for seed in range(20):
        episode = draw(seed, odometry=True)
        assert np.abs(episode.measurement[:, episode.layout.angles]).max() <= np.pi


def test_the_layout_depends_on_scene_and_odometry(episode):
    assert episode.layout == Layout(3) and episode.measurement.shape == (200, 13)
    assert draw(scene=replace(STREET, walls=())).measurement.shape == (200, 5)
    assert draw(odometry=True).measurement.shape == (200, 15)


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
    episode = draw(1, odometry=True)
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
