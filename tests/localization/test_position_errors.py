"""Tests that statistics of position errors equal NumPy's, however the errors are split."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mmwave_env.localization.position_errors import (
    DISTANCES_M,
    SHARES,
    PositionErrors,
    horizontal_level,
    vertical_level,
)

ERRORS = hnp.arrays(float, st.tuples(st.integers(1, 60), st.just(3)), elements=st.floats(-50, 50))


def covariances(n, seed=0):
    """Return random packed covariances (n, 28)."""
    factor = np.random.default_rng(seed).normal(size=(n, 7, 7))
    return (factor @ np.swapaxes(factor, 1, 2))[(..., *np.tril_indices(7))]


def assert_figures(figures, size, level):
    assert figures["epochs"] == len(size)
    assert [*figures["percentiles_m"].values()] == np.quantile(size, SHARES).tolist()
    assert [*figures["within_m"].values()] == [(size <= limit).mean() for limit in DISTANCES_M]
    assert figures["median_level_m"] == np.median(level)
    assert figures["exceeded"] == (size > level).sum()


@settings(max_examples=25, deadline=None)
@given(error=ERRORS, cut=st.integers(0, 60))
def test_statistics_of_errors_in_any_pieces_equal_those_of_numpy(error, cut):
    errors, P = PositionErrors(risk=0.05), covariances(len(error))
    for part in (slice(cut), slice(cut, None)):
        errors.add(error[part], P[part])
    figures = errors.figures()
    assert figures == errors.figures()
    across, upwards = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    assert_figures(figures["horizontal"], across, horizontal_level(P, 0.05))
    assert_figures(figures["vertical"], upwards, vertical_level(P, 0.05))


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
    assert figures["epochs"] == 0 and figures["share"] is None
    assert {*figures["percentiles_m"].values(), *figures["within_m"].values()} == {None}
