"""Tests of radios: formulas, files, and statistics of the channel (each with 99.9 % confidence).

A *spell* is a period in which a link is blocked, or in which multipath disturbs it.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import binom, chi2, kstest, lognorm, norm

from mmwave_env.models.layout import Layout
from mmwave_env.models.radio import RADIOS, Radio, radio_from
from mmwave_env.models.scene import SCENES
from mmwave_env.world.channel import channel_epoch, channel_of, initial_state
from tests.paths import write_json
from tests.refusals import refuses

STREET = SCENES["street"]
CONFIDENCE = 0.999
Z = norm.ppf(0.5 + CONFIDENCE / 2.0)  # a standard normal number is in ±Z with this confidence
EFFECTS = ("shadowing_db", "blockage_scale", "multipath_rate_hz", "outage_rate_hz")
CLEAR = replace(RADIOS["standard"], **dict.fromkeys(EFFECTS, 0.0))

every_radio = pytest.mark.parametrize("name", RADIOS)


def channel(radio, epochs, users, distance_m=100.0, speed_mps=0.0, dt=1.0, links=1):
    """Simulate independent channels of users at constant distance and speed.

    Returns:
        A namespace. snr_db, detected and range_bias_m are arrays (epochs, users, links), or
        (epochs, users) if there is one link. angle_bias_rad (epochs, users, 3) has the biases of
        the first link's angles. doppler_spread_hz is an array (epochs, users).
    """
    rng = np.random.default_rng(0)
    dice = SimpleNamespace(
        uniform=lambda: rng.random(users),
        exponential=lambda: rng.standard_exponential(users),
        normal=lambda: rng.standard_normal(users),
    )
    state = initial_state(links)
    receptions = []
    model = channel_of(radio, STREET, Layout(links), dt)
    distance = [np.full(users, distance_m)] * links
    speed = np.full(users, speed_mps)
    for t in range(epochs):
        state, reception = channel_epoch(model, state, t == 0, dice, distance, speed)
        receptions.append(reception)

    def of_links(values):
        stacked = np.moveaxis(np.array(values, float), 1, 2)
        return stacked[:, :, 0] if links == 1 else stacked

    bias = [np.broadcast_arrays(*[b for link in r.bias for b in link]) for r in receptions]
    bias = np.array(bias).reshape(epochs, links, 4, users)
    return SimpleNamespace(
        snr_db=of_links([r.snr_db for r in receptions]),
        detected=of_links([np.broadcast_arrays(*r.detected) for r in receptions]) > 0.5,
        range_bias_m=of_links(bias[:, :, 0]),
        angle_bias_rad=np.moveaxis(bias[:, 0, 1:], 1, 2),
        doppler_spread_hz=np.array([r.doppler_spread_hz for r in receptions]),
    )


def assert_share(events, chance):
    """Assert that the number of events is within the binomial interval for their chance."""
    low, high = binom.interval(CONFIDENCE, events.size, chance)
    assert low <= events.sum() <= high


def assert_variance(values, variance):
    """Assert the variance of independent normal numbers with mean zero."""
    low, high = chi2.interval(CONFIDENCE, values.size)
    assert low <= np.square(values).sum() / variance <= high


def changes(on):
    """Return two masks: whether a spell ends (epochs in a spell) or begins (other epochs)."""
    before = on[:-1]
    after = on[1:]
    return ~after[before], after[~before]


# --- link budget and noise


@every_radio
def test_the_snr_at_100_m_equals_the_value_computed_by_hand(name):
    # The path loss is 32.4 + 21 log10(100) + 20 log10(28) = 32.4 + 42 + 28.943 dB. The signal has
    # 27 + 21 + 12 - 10 dBm (power, antenna gains, implementation loss) minus the path loss. The
    # noise has -174 + 80 + 8 dBm (density, bandwidth, noise figure). A reflection costs 8 dB.
    radio = replace(RADIOS[name], shadowing_db=0.0, blockage_scale=0.0)
    snr = channel(radio, 1, 1, links=3).snr_db
    assert_allclose(snr, [[[32.657, 24.657, 24.657]]], atol=1e-3)


def test_blockage_reduces_the_snr_by_25_db():
    users = channel(replace(CLEAR, blockage_scale=0.5), 200, 3)
    blocked = users.range_bias_m > 0.0
    assert blocked.any() and not blocked.all()
    loss = channel(CLEAR, 200, 3).snr_db - users.snr_db
    assert_allclose(loss, np.where(blocked, 25.0, 0.0), atol=1e-9)


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


# --- shadowing, detection, Doppler spread


@pytest.mark.parametrize("dt", [0.5, 1.0, 2.0])
def test_shadowing_is_a_stationary_autoregression(dt):
    clear = channel(CLEAR, 40, 4000).snr_db
    x = channel(replace(CLEAR, shadowing_db=3.0), 40, 4000, dt=dt).snr_db - clear
    rho = 0.9**dt
    assert_variance(x[0], 3.0**2)
    assert_variance(x[-1], 3.0**2)
    assert_variance(x[1:] - rho * x[:-1], 3.0**2 * (1.0 - rho**2))
    products = (x[1:] - rho * x[:-1]) * x[:-1]
    deviation = 3.0**2 * np.sqrt(1.0 - rho**2)
    assert abs(products.mean()) <= Z * deviation / np.sqrt(products.size)


@pytest.mark.parametrize("snr_db", [1.0, 4.0, 5.5, 10.0])
def test_the_probability_of_detection_is_logistic_in_the_snr(snr_db):
    at_100_m = channel(CLEAR, 1, 1).snr_db.item()
    radio = replace(
        CLEAR, transmit_dbm=CLEAR.transmit_dbm + snr_db - at_100_m, reflection_loss_db=0
    )
    users = channel(radio, 100, 200)
    assert_allclose(users.snr_db, snr_db)
    assert_share(users.detected, 1.0 / (1.0 + np.exp(-(snr_db - 4.0) / 1.5)))


def test_doppler_spread_of_a_moving_user_is_lognormal_around_0_3_v():
    radio = replace(CLEAR, spread_floor_mps=0.0)
    spread = channel(radio, 1, 20_000, speed_mps=10.0).doppler_spread_hz[0] / STREET.hz_per_mps
    assert kstest(spread, lognorm(0.2, scale=3.0).cdf).pvalue > 1.0 - CONFIDENCE


# --- blockage, multipath, outage


@pytest.mark.parametrize(
    ("distance_m", "chance"), [(50.0, 0.045), (100.0, 0.075), (300.0, 0.175), (900.0, 0.175)]
)
def test_blockage_is_stationary_with_its_probability(distance_m, chance):
    radio = replace(CLEAR, blockage_scale=0.5)
    blocked = channel(radio, 60, 4000, distance_m).range_bias_m > 0.0
    assert_share(blocked[0], chance)
    assert_share(blocked[-1], chance)


@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_a_blockage_lasts_4_s_on_average(dt):
    radio = replace(CLEAR, blockage_scale=0.5)
    blocked = channel(radio, 1000, 200, dt=dt).range_bias_m > 0.0
    ends, begins = changes(blocked)
    leave = 1.0 - np.exp(-dt / 4.0)  # chance that a blockage ends within dt
    assert_share(ends, leave)
    assert_share(begins, leave * 0.075 / (1.0 - 0.075))


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_multipath_comes_and_goes_at_its_rates(dt):
    users = channel(replace(CLEAR, multipath_rate_hz=0.008), 2000, 200, dt=dt)
    reflected = users.range_bias_m > 0.0
    ends, begins = changes(reflected)
    assert_share(begins, 1.0 - np.exp(-0.008 * dt))
    assert_share(ends, 1.0 - np.exp(-dt / 3.3))
    assert_array_equal(users.snr_db, channel(CLEAR, 2000, 200).snr_db)  # not changed


# Cause of biases -> radio with this cause alone; minimum of the range biases (m); their mean
# minus this minimum (m); standard deviation of the angle biases (deg).
BIASES = {
    "blockage": (replace(CLEAR, blockage_scale=0.5), 0.0, 3.0, 3.0),
    "multipath": (replace(CLEAR, multipath_rate_hz=0.008), 1.0, 4.0, 5.0),
}


@pytest.mark.parametrize("kind", BIASES)
def test_biases_are_drawn_once_per_spell(kind):
    radio, least_m, mean_m, angle_deg = BIASES[kind]
    users = channel(radio, 1000, 100)
    bias = users.range_bias_m
    angle = users.angle_bias_rad
    on = bias > 0.0
    assert ((angle != 0.0) == on[..., None]).all()
    within = on[1:] & on[:-1]
    assert_array_equal(bias[1:][within], bias[:-1][within])
    assert_array_equal(angle[1:][within], angle[:-1][within])
    first = on.copy()
    first[1:] &= ~on[:-1]
    assert len(np.unique(bias[first])) == first.sum()
    assert kstest(bias[first], "expon", (least_m, mean_m)).pvalue > 1.0 - CONFIDENCE
    assert_variance(angle[first], np.deg2rad(angle_deg) ** 2)


# --- arguments


def test_a_radio_is_given_by_name_or_as_an_object():
    assert radio_from("high") is RADIOS["high"] and radio_from(CLEAR) is CLEAR


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
