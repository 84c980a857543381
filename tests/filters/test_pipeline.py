"""Noise that a mode believes in: by Doppler spread, adaptive scale and drop of the SNR."""

from dataclasses import replace

import numpy as np
import pytest

from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, measurement_of, predict_update, process_noise
from mmwave_env.models.measurement import Epoch, Layout, blank_site
from tests.filters.tracks import unpacked

LAYOUT = Layout(3)
SITE = blank_site(LAYOUT)._replace(hz_per_mps=93.4)
SIGMA = np.linspace(0.5, 1.5, LAYOUT.size).tolist()
EPOCH = Epoch(1.0, [0.0] * LAYOUT.size, SIGMA, [0.0] * 4, [20.0] * 3, 300.0)
MEMORY = initial_memory(LAYOUT, 1)
MODE = Mode("own", sigma_v=0.5, sigma_p=0.1, coupling=False)


def diagonal(mode, gamma=1.0):
    return np.array(process_noise(mode.tuning, EPOCH, SITE.hz_per_mps, gamma, False).diagonal)


def test_velocity_noise_grows_with_the_doppler_spread():
    grown = diagonal(replace(MODE, spread_gain=0.01)) - diagonal(MODE)
    np.testing.assert_allclose(grown, [0.0, 0.0, 0.0, 3.0, 3.0, 0.0, 0.0])  # 0.01 * 300 Hz


@pytest.mark.parametrize("adaptive", [True, False])
def test_gamma_scales_process_and_measurement_noise_of_adaptive_modes(adaptive):
    mode = replace(MODE, adaptive=adaptive)
    memory, scale = MEMORY._replace(gamma=1.5), 1.5 if adaptive else 1.0
    P = [float(i == j) for i in range(7) for j in range(i + 1)]
    after = predict_update(Pipeline((mode,), LAYOUT), mode, SITE.prior_x, P, memory, EPOCH, SITE)
    F = np.eye(7) + np.eye(7, k=3) * (np.arange(7) < 3)[:, None]
    Q = unpacked(np.array(after.P_predicted)) - F @ F.T
    np.testing.assert_allclose(Q, scale * np.diag(diagonal(mode)), atol=1e-12)
    variance = measurement_of(mode, memory, EPOCH, SITE, LAYOUT).variance
    np.testing.assert_allclose(variance, scale * np.square(SIGMA))


@pytest.mark.parametrize(("drop_db", "factor"), [(0.0, 1.0), (6.0, 1.0), (12.0, 4.0), (60.0, 10.0)])
def test_a_drop_of_the_snr_inflates_the_noise_of_that_link_alone(drop_db, factor):
    memory = MEMORY._replace(snr_mean_db=[20.0, 20.0 + drop_db, 20.0])
    mode = replace(MODE, blockage_aware=True)
    expected = np.square(SIGMA)
    expected[LAYOUT.link(1)] *= factor
    np.testing.assert_allclose(measurement_of(mode, memory, EPOCH, SITE, LAYOUT).variance, expected)
