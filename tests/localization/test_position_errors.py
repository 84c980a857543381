"""Tests of Gaussian protection levels (bounds on errors), and of statistics of position errors."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.stats import beta, norm

from mmwave_env.localization.levels import Levels
from mmwave_env.localization.position_errors import (
    DISTANCES_M,
    SHARES,
    PositionErrors,
    exceedance,
    gaussian_levels,
    horizontal_level,
)
from tests.filters.tracks import packed
from tests.refusals import refuses

risks = st.floats(-7.0, np.log10(0.5)).map(lambda power: 10.0**power)
few = settings(max_examples=25)


def turned(major, minor, angle):
    """Return the packed covariance of a turned horizontal ellipse and a vertical variance of 1."""
    turn = Rotation.from_euler("z", angle).as_matrix()
    return packed(turn @ np.diag([major**2, minor**2, 1.0]) @ turn.T)


def beyond(distance, major, minor):
    """Return P(|e| > distance), e ~ N(0, diag(major^2, minor^2)), by an integral over e_2."""

    def given_minor(y):
        rest = np.sqrt(max(distance**2 - (minor * y) ** 2, 0.0)) / major
        return norm.pdf(y) * 2.0 * norm.sf(rest)

    end = min(distance / minor, 40.0)
    inside, _ = quad(given_minor, 0.0, end, epsabs=1e-13, limit=300, points=[end / 9.0, end / 3.0])
    return 2.0 * (inside + norm.sf(distance / minor))


@few
@given(
    risk=risks, major=st.floats(0.01, 100.0), ratio=st.floats(0.01, 1.0), angle=st.floats(0.0, 7.0)
)
def test_errors_exceed_the_horizontal_level_with_the_stated_probability(risk, major, ratio, angle):
    level = float(horizontal_level(turned(major, ratio * major, angle), risk))
    assert beyond(level, major, ratio * major) == pytest.approx(risk, rel=2e-5)


@few
@given(risk=risks, sigma=st.floats(0.01, 100.0))
def test_levels_of_a_line_and_of_a_circle_equal_the_textbook(risk, sigma):
    expected = sigma * norm.isf(0.5 * risk)
    line = horizontal_level(turned(sigma, 0.0, 1.0), risk)
    circle = horizontal_level(turned(sigma, sigma, 1.0), risk)
    assert line == pytest.approx(expected, rel=1e-6)
    assert circle == pytest.approx(sigma * np.sqrt(-2.0 * np.log(risk)), rel=1e-6)  # Rayleigh
    upwards = packed(np.diag([9.0, 4.0, sigma**2]))
    assert gaussian_levels(upwards, risk)[1] == pytest.approx(expected)


@pytest.mark.parametrize(("exceeded", "epochs"), [(0, 50), (3, 200), (7, 7)])
def test_the_share_of_exceeded_levels_has_the_clopper_pearson_interval(exceeded, epochs):
    error = np.zeros(epochs)
    error[:exceeded] = 2.0
    figures = exceedance(error, np.ones(epochs))
    low = beta.ppf(0.025, exceeded, epochs - exceeded + 1) if exceeded else 0.0
    high = beta.ppf(0.975, exceeded + 1, epochs - exceeded) if exceeded < epochs else 1.0
    assert figures["exceeded"] == exceeded and figures["share"] == exceeded / epochs
    assert figures["ci95"] == pytest.approx([low, high])


def test_an_error_or_a_level_of_nan_counts_as_an_exceeded_level():
    error = np.array([np.nan, 1.0, 1.0])
    level = np.array([5.0, np.nan, 5.0])
    assert exceedance(error, level)["exceeded"] == 2


@pytest.mark.parametrize("risk", [0.0, -1.0, 0.6, np.nan, np.inf])
def test_an_impossible_risk_is_refused(risk):
    with refuses("risk"):
        Levels(risk, "gaussian")


ERRORS = hnp.arrays(float, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-50, 50))


def covariances(*shape, seed=0):
    """Return random packed covariances (*shape, 28)."""
    factor = np.random.default_rng(seed).normal(size=(*shape, 7, 7))
    return packed(factor @ np.swapaxes(factor, -2, -1))


def assert_figures(figures, size, level):
    assert figures["epochs"] == len(size)
    assert [*figures["percentiles_m"].values()] == np.quantile(size, SHARES).tolist()
    assert [*figures["within_m"].values()] == [(size <= limit).mean() for limit in DISTANCES_M]
    assert figures["median_level_m"] == np.median(level)
    assert figures["exceeded"] == (size > level).sum()


@few
@given(error=ERRORS, cut=st.integers(0, 60))
def test_statistics_of_errors_in_any_pieces_equal_statistics_in_numpy(error, cut):
    errors = PositionErrors(risk=0.05)
    P = covariances(len(error))
    for part in (slice(cut), slice(cut, None)):
        errors.add(error[part], P[part])
    figures = errors.figures()
    assert figures == errors.figures()
    sizes = {"horizontal": np.hypot(error[:, 0], error[:, 1]), "vertical": np.abs(error[:, 2])}
    for (kind, size), level in zip(sizes.items(), gaussian_levels(P, 0.05).T, strict=True):
        assert_figures(figures[kind], size, level)


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_errors_that_are_not_finite_count_as_large_and_give_valid_json(lost):
    error = np.ones((10, 3))
    error[6:] = lost
    errors = PositionErrors()
    errors.add(error, covariances(10))
    figures = errors.figures()["horizontal"]
    assert figures["percentiles_m"]["50"] == pytest.approx(2**0.5)
    assert figures["percentiles_m"]["90"] is None and figures["within_m"]["10"] == 0.6
    assert figures["exceeded"] >= 4
    json.dumps(errors.figures(), allow_nan=False)


def test_statistics_without_errors_are_none():
    figures = PositionErrors().figures()["horizontal"]
    assert figures["epochs"] == 0 and figures["share"] is figures["ci95"] is None
    assert {*figures["percentiles_m"].values(), *figures["within_m"].values()} == {None}
