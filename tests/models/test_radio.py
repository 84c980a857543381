"""Tests of radios, shipped, in files and random, and of priors; tests/world tests the channel."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import exact_rows
from mmwave_env.models.prior import prior_from_fix
from mmwave_env.models.radio import RADIOS, Radio, radio_from, random_radio
from mmwave_env.models.random_scene import WIDE_SCENE
from mmwave_env.models.scene import SCENES
from mmwave_env.task import task_from
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import wrapped
from tests.paths import write_json
from tests.refusals import refuses

STREET = SCENES["street"]

every_radio = pytest.mark.parametrize("name", RADIOS)


# --- link budget and noise


@every_radio
def test_the_snr_at_100_m_equals_the_value_computed_by_hand(name):
    # The path loss is 32.4 + 21 log10(100) + 20 log10(28) = 32.4 + 42 + 28.943 dB. The signal has
    # 27 + 21 + 12 - 10 dBm (power, antenna gains, implementation loss) minus the path loss. The
    # noise has -174 + 80 + 8 dBm (density, bandwidth, noise figure).
    snr_db = RADIOS[name].snr_db(-32.4 - 42.0 - 28.943, 100e6)
    assert snr_db == pytest.approx(32.657, abs=1e-3)


# Columns: antenna elements of the base station, antenna elements of the user, and noise floors of
# the range on the direct path (m), the range on reflected paths (m), the azimuth of arrival (deg),
# the elevation (deg), the azimuth of departure (deg) and the Doppler shift (m/s).
PROFILES = {
    "handset": (4, 2, 0.5, 0.8, 3.0, 2.0, 2.0, 0.1),
    "standard": (8, 4, 0.2, 0.4, 1.0, 0.7, 0.5, 0.1),
    "high": (16, 8, 0.1, 0.2, 0.5, 0.4, 0.25, 0.05),
}


@every_radio
@pytest.mark.parametrize("snr_db", [-10.0, 3.0, 20.0, 45.0])
def test_sigma_combines_floor_and_cramer_rao_bound_in_quadrature(name, snr_db):
    gnb, ue, direct, reflected, aoa, elevation, aod, doppler = PROFILES[name]
    snrs_db = snr_db + np.array([0.0, 6.0, -6.0])
    effective_bandwidth = 100e6 / np.sqrt(12.0)
    ends = ((aoa, ue), (elevation, ue), (aod, gnb))
    expected = []
    for floor, snr in zip((direct, reflected, reflected), 10.0 ** (snrs_db / 10.0), strict=True):
        bound = 299_792_458.0 / (2 * np.pi * effective_bandwidth * np.sqrt(2 * snr))
        expected.append(np.sqrt(floor**2 + bound**2))
        for floor_deg, elements in ends:
            variance = 6.0 / (snr * (elements**2 - 1) * np.pi**2)
            expected.append(np.sqrt(np.deg2rad(floor_deg) ** 2 + variance))
    # The Doppler shift is measured on the direct path.
    doppler_bound_hz = np.sqrt(6.0 / 10.0 ** (snr_db / 10.0)) / (2 * np.pi * 10e-3)
    expected.append(np.sqrt((doppler * 28e9 / 299_792_458.0) ** 2 + doppler_bound_hz**2))
    expected += [0.1, np.deg2rad(3.0)]  # odometry: speed (m/s) and heading
    sigma = RADIOS[name].sigma(np.tile(snrs_db, (2, 1)), STREET, Layout(odometry=True))
    assert_allclose(sigma, [expected] * 2, rtol=1e-12)


@every_radio
def test_the_prior_covariance_is_diagonal_with_the_variances_of_the_profile(name):
    position = {"handset": 4.0, "standard": 3.0, "high": 2.0}[name]
    P = RADIOS[name].prior_covariance(STREET)
    assert_allclose(np.sqrt(np.diag(P)[:2]), position)
    assert_array_equal(P, np.diag(np.diag(P)))
    assert (np.diag(P) > 0.0).all()


# --- arguments


def test_a_radio_file_lists_the_differences_from_its_base(tmp_path):
    own = {"base": "handset", "shadowing_db": 6, "range_floor_m": [1, 2.5], "gnb_elements": 16}
    assert radio_from(write_json(tmp_path / "phone.json", own)) == replace(
        RADIOS["handset"], name="phone", shadowing_db=6.0, range_floor_m=(1.0, 2.5), gnb_elements=16
    )
    named = write_json(tmp_path / "phone.json", {"name": "lab"})
    assert radio_from(str(named)) == Radio("lab")


def test_angles_in_a_radio_file_have_the_unit_in_their_names(tmp_path):
    expected = Radio("phone", aoa_floor_rad=np.radians(2.0))
    for content in ({"aoa_floor_deg": 2.0}, {"aoa_floor_rad": np.radians(2.0)}):
        assert radio_from(write_json(tmp_path / "phone.json", content)) == expected


@pytest.mark.parametrize(
    ("content", "field"),
    [
        ({"aoa_flor_deg": 2.0}, "key"),
        ({"aoa_floor_deg": 2.0, "aoa_floor_rad": 0.1}, "aoa_floor_rad"),
        # tests/engines/test_extremes.py checks the bounds of all numbers.
        ({"aoa_floor_deg": -2.0}, "aoa_floor_rad of radio 'phone'"),
        ({"range_floor_m": [0.2, -0.4]}, "range_floor_m of radio 'phone'"),
        ({"name": "handset"}, "name"),
    ],
    ids=repr,
)
def test_a_damaged_radio_file_is_refused_with_the_name_of_the_field(tmp_path, content, field):
    path = write_json(tmp_path / "phone.json", content)
    with refuses(path, field):
        radio_from(path)


# --- random radios

HANDSET = RADIOS["handset"]


def test_floors_and_rates_differ_from_the_profile_by_at_most_the_factor():
    rng = np.random.default_rng(0)
    drawn = [random_radio(HANDSET, rng, 2.0, 3.0) for _ in range(200)]
    for name in ("aoa_floor_rad", "range_floor_m", "multipath_rate_hz", "blockage_mean_s"):
        values = np.array([np.ravel(getattr(radio, name)) for radio in drawn])
        ratios = values / np.ravel(getattr(HANDSET, name))
        assert 0.5 <= ratios.min() < 0.55 and 1.8 < ratios.max() <= 2.0
        assert abs(np.log(ratios[:, 0]).mean()) < 0.1
    budgets = np.array([radio.transmit_dbm - HANDSET.transmit_dbm for radio in drawn])
    assert -3.0 <= budgets.min() < -2.5 and 2.5 < budgets.max() <= 3.0
    assert {radio.base for radio in drawn} == {"handset"}


def test_a_factor_of_one_gives_the_profile():
    same = random_radio(HANDSET, np.random.default_rng(0), 1.0, 0.0)
    assert all(getattr(same, f.name) == getattr(HANDSET, f.name) for f in fields(Radio))


def test_every_random_radio_is_within_the_limits_of_simulations():
    rng = np.random.default_rng(1)
    for profile in RADIOS.values():
        for _ in range(20):
            SimulatedSource(WIDE_SCENE, random_radio(profile, rng, 4.0, 10.0))


def test_wide_streets_are_a_scene_of_the_environment():
    source = task_from(scene="wide").simulated
    heights = [source.scene_of(key).anchors_m[0, 2] for key in range(100)]
    assert min(heights) < 6.0 and max(heights) > 20.0


# --- priors that are computed from one link (a *fix*)

GNB = STREET.anchors_m[0]
# Standard deviations of range (m), azimuth of arrival, elevation and azimuth of departure (rad).
SIGMA = np.array([0.3, 0.02, 0.015, 0.01])


def link_from(position):
    """Return the exact values (4,) of the base station's link to a user at rest."""
    return np.array(exact_rows(position, [0.0] * 3, [GNB], 1.0, Layout(1))[:4])


@given(st.tuples(st.floats(-200, 200), st.floats(-200, 200), st.floats(0, 5)))
def test_a_fix_without_noise_is_the_true_position_and_leaves_the_velocity_unknown(position):
    if np.hypot(*(np.array(position[:2]) - GNB[:2])) < 1.0:
        return  # directly below the anchor, azimuths are undefined
    mean, covariance = prior_from_fix(GNB, link_from(position), SIGMA, HANDSET, STREET)
    assert_allclose(mean[:3], position, atol=1e-9)
    assert_array_equal(mean[3:], 0.0)
    assert_allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    rest = HANDSET.prior_covariance(STREET)
    rest[3, 3] = rest[4, 4] = HANDSET.start_velocity_mps**2
    assert_array_equal(covariance[3:, 3:], rest[3:, 3:])
    assert_array_equal(covariance[:3, 3:], 0.0)


@pytest.mark.parametrize("position", [(80.0, -20.0, 1.5), (-60.0, 10.2, 1.5), (10.5, -90.0, 1.5)])
def test_the_covariance_of_a_fix_is_right(position):
    exact = link_from(position)
    rng = np.random.default_rng(0)
    scores = []
    for _ in range(1000):
        link = exact + SIGMA * rng.standard_normal(4)
        link[1:] = wrapped(link[1:])
        mean, covariance = prior_from_fix(GNB, link, SIGMA, RADIOS["standard"], STREET)
        error = mean[:3] - position
        scores.append(error @ np.linalg.solve(covariance[:3, :3], error))
    assert np.mean(scores) == pytest.approx(3.0, rel=0.15)
