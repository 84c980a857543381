"""Tests of the interacting multiple model (IMM) against single filters and a textbook's IMM."""

import numpy as np
import pytest
from scipy.stats import chi2

from mmwave_env.filters import textbook
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.layout import Layout
from tests.filters import gated_textbook
from tests.filters.tracks import assert_same_beliefs, imm_track, simulated, track

EPOCHS = 60


@pytest.mark.slow
def test_an_imm_of_identical_modes_equals_one_of_them_and_keeps_equal_probabilities():
    episodes = simulated(9, EPOCHS)
    twins = Pipeline((Mode("a", "ukf"), Mode("b", "ukf")), Layout(3))
    imm = imm_track(twins, episodes)
    single = track(Pipeline(twins.modes[:1], Layout(3)), episodes, 0, EPOCHS, ("x", "P"))
    assert_same_beliefs(imm, single, rtol=1e-11)
    np.testing.assert_allclose(imm["probability"], 0.5, rtol=1e-9)


def textbook_imm(episode, modes, transitions, nis_quantile=1.0, change=None):
    """Run the IMM of Bar-Shalom, Li and Kirubarajan 2001, Sec. 11.6.6, without gates.

    ``modes`` are pairs (method, Q of one second), whose noise is not adapted; ``transitions`` has
    one matrix per epoch. In likelihoods, NIS is capped at the chi-square quantile of
    ``nis_quantile``. If given, ``change(t, probabilities)`` returns new probabilities after epoch
    t. The results are x (T, 7), P (T, 7, 7) and probabilities (T, M).
    """
    most = chi2.ppf(nis_quantile, [4, 4, 4, 1])
    sensor = textbook.Sensor(episode.scene_anchors_m, episode.hz_per_mps)
    M, probability = len(modes), np.full(len(modes), 1.0 / len(modes))
    x = np.tile(episode.prior_mean, (M, 1))
    P = np.tile(episode.prior_covariance, (M, 1, 1))
    out = []
    for t in range(len(episode)):
        dt = episode.time_s[t] - episode.time_s[t - 1] if t else 0.0
        predicted, mixed_x, mixed_P = textbook.mix(probability, transitions[t], x, P)
        log_likelihood = np.empty(M)
        for j, (method, Q) in enumerate(modes):
            prior = textbook.predict(mixed_x[j], mixed_P[j], Q * dt, dt)
            measured = episode.table()[t, 1:14], episode.sigma[t] ** 2, episode.usable[t]
            groups = sensor.groups, sensor.links
            moments = textbook.METHODS[method]
            step = gated_textbook.update(moments, sensor, *groups, *prior, *measured)
            x[j], P[j] = step.x, step.P
            log_likelihood[j] = step.log_likelihood + 0.5 * np.maximum(step.nis - most, 0.0).sum()
        probability = textbook.reweigh(predicted, log_likelihood)
        if change:
            probability = change(t, probability)
        out.append((*textbook.combine(probability, x, P), probability))
    return [np.array(column) for column in zip(*out, strict=True)]
