"""Tests of whitened innovations, of their sensitivities to errors, and of robust least squares."""

import numpy as np

from mmwave_env.localization.sensitivities import fit, innovations, rho
from tests.localization.errors import late, readings


def test_least_squares_finds_an_error_despite_outliers():
    rng = np.random.default_rng(5)
    J = rng.standard_normal((200, 5, 2))
    w = J @ [2.0, -1.0] + rng.standard_normal((200, 5))
    w[::9] += 30.0
    fitted = fit(w, J, 100.0)
    assert abs(fitted.theta - [2.0, -1.0]).max() < 4.0 * fitted.sigma.max() < 0.4
    assert fitted.wald > 100.0 and fitted.gain > 50.0


def test_correlated_innovations_make_an_error_less_certain():
    rng = np.random.default_rng(6)
    white = rng.standard_normal((400, 4))
    slow = np.repeat(rng.standard_normal((20, 4)), 20, axis=0)
    J = np.ones((400, 4, 1))
    assert fit(slow, J, 100.0).sigma > 2.5 * fit(white, J, 100.0).sigma


def test_a_prior_keeps_an_unobservable_error_small():
    fitted = fit(np.ones((100, 3)), np.zeros((100, 3, 1)), 10.0)
    assert fitted.theta == 0.0 and fitted.wald == 0.0 and fitted.gain == 0.0


def test_the_gain_of_few_blocks_does_not_count():
    w = np.zeros((200, 2))
    w[:10] = 1.5  # one block of 20
    assert fit(w, np.where(w[..., None] > 0.0, 1.0, 0.0), 100.0).gain == 0.0


def test_innovations_of_a_correct_log_are_white_and_those_of_a_wrong_one_are_not():
    (reading,) = readings(1)
    right, wrong = innovations([reading, late(3.0)(reading)])
    used = np.repeat(reading.log.visible, reading.log.layout.widths, axis=1)
    used[0, :4] = False  # spent for the start
    assert (right[~used] == 0.0).all()
    assert 0.5 < np.median(abs(right[used])) / 0.6745 < 1.3
    assert rho(wrong).sum() > rho(right).sum() + 50.0
