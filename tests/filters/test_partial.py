"""Tests of partial layouts, in which any row of a measurement may be missing.

With missing rows, NEES and NIS are chi-square.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mmwave_env.filters import Mode, Pipeline
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import exact_rows
from tests.filters.tracks import (
    HZ_PER_MPS,
    far_from_the_anchors,
    process_noise,
    some_rows,
    track,
)

RUNS = 600
EPOCHS = 25
LEVEL = 0.01
QUIET = {"gate": None, "adaptive": False, "sigma_v": 0.3}


@pytest.fixture(scope="module")
def runs():
    """Return NEES, NIS and a mask of measured rows, for episodes that obey the filter's model.

    Half of the rows are missing.
    """
    model = far_from_the_anchors(process_noise(Mode("ekf", "ekf", **QUIET)))
    rng = np.random.default_rng(0)
    drawn = [some_rows(model.draw(rng, EPOCHS), rng, 0.5) for _ in range(RUNS)]
    episodes = [with_its_doppler(episode, model) for episode in drawn]
    pipeline = Pipeline((Mode("ekf", "ekf", **QUIET),), episodes[0].layout)
    results = track(pipeline, episodes, 0, EPOCHS, ("nees", "memory.nis"))
    rows = np.isfinite([episode.measurement for episode in episodes]).swapaxes(0, 1)
    return results["nees"], results["memory.nis"], rows


def with_its_doppler(episode, model):
    """Return the episode with Doppler shifts measured at each epoch's ``doppler_anchor``."""
    sensor = model.sensor
    row = episode.layout.doppler
    z = episode.measurement.copy()
    truth = [*episode.truth_position_m.T], [*episode.truth_velocity_mps.T]
    shifts = [
        exact_rows(*truth, [anchor.tolist()], HZ_PER_MPS, Layout(1))[4] for anchor in sensor.anchors
    ]
    epochs = np.arange(len(episode))
    z[:, row] += np.array(shifts)[episode.doppler_anchor, epochs] - shifts[0]
    return replace(episode, measurement=z)


def assert_sum(values, dof):
    """Assert that the sum is in the 99 % interval of chi-square with ``dof`` degrees of freedom."""
    low, high = chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], dof)
    assert low < values.sum() < high, (low, values.sum(), high)


@pytest.mark.parametrize("epoch", [0, 5, EPOCHS - 1])
def test_nees_with_missing_rows_and_doppler_shifts_of_any_anchor_is_chi_square(runs, epoch):
    nees, _, _ = runs
    assert_sum(nees[epoch], 3 * RUNS)


def test_nis_is_chi_square_with_a_degree_of_freedom_per_measured_row(runs):
    _, nis, rows = runs
    links = rows[..., :12].reshape(EPOCHS, RUNS, 3, 4).sum(axis=-1)
    assert not nis[..., :3][links == 0].any()
    for count in (1, 2, 3, 4):
        values = nis[..., :3][links == count]
        assert_sum(values, count * len(values))
    doppler = nis[..., 3][rows[..., 12]]
    assert_sum(doppler, len(doppler))
