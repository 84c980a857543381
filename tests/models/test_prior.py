"""Tests of priors that are computed from one link (a *fix*)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.models.layout import Layout
from mmwave_env.models.prior import prior_from_fix
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, Scene
from tests.filters.tracks import geometry, wrapped

SCENE = SCENES["street"]
GNB = SCENE.anchors_m[0]
# Standard deviations of range (m), azimuth of arrival, elevation and azimuth of departure (rad).
SIGMA = np.array([0.3, 0.02, 0.015, 0.01])


def link_from(position):
    """Return the exact values (4,) of the base station's link to a user at rest."""
    track = np.array([position], float)
    alone = Scene("alone", SCENE.base_station_m)
    return geometry(track, np.zeros((1, 3)), alone, Layout(1))[0, :4]


@given(st.tuples(st.floats(-200, 200), st.floats(-200, 200), st.floats(0, 5)))
def test_a_fix_without_noise_is_the_true_position_and_leaves_the_velocity_unknown(position):
    if np.hypot(*(np.array(position[:2]) - GNB[:2])) < 1.0:
        return  # directly below the anchor, azimuths are undefined
    radio = RADIOS["handset"]
    mean, covariance = prior_from_fix(GNB, link_from(position), SIGMA, radio, SCENE)
    assert_allclose(mean[:3], position, atol=1e-9)
    assert_array_equal(mean[3:], 0.0)
    assert_allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > 0.0
    rest = radio.prior_covariance(SCENE)
    rest[3, 3] = rest[4, 4] = radio.start_velocity_mps**2
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
        mean, covariance = prior_from_fix(GNB, link, SIGMA, RADIOS["standard"], SCENE)
        error = mean[:3] - position
        scores.append(error @ np.linalg.solve(covariance[:3, :3], error))
    assert np.mean(scores) == pytest.approx(3.0, rel=0.15)
