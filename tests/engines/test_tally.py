"""Running sums against the metrics of whole tracks."""

import numpy as np
import pytest

from mmwave_env.engines.tally import Tally, count
from mmwave_env.metrics import accuracy


@pytest.mark.parametrize("axes", [2, 3])
@pytest.mark.parametrize("dt", [1e-9, 0.1, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("epochs", [1, 5, 10, 11, 12, 25, 200])
def test_an_episode_ends_with_the_metrics_of_its_track(epochs, dt, axes):
    rng, tally, where = np.random.default_rng(epochs), Tally(3, axes), np.array([1])
    for _ in range(2):  # the one before leaves nothing
        tally.begin(where, np.array([dt]), np.array([epochs]))
        errors = rng.normal(0.0, 20.0, (epochs, 3))
        nees = rng.chisquare(axes, epochs)
        for k, (error, number) in enumerate(zip(errors, nees, strict=True)):
            count(
                tally.sums[1], tally.errors[1], tally.second[1], tally.interval, k, *error, number
            )
        found = tally.metrics(where, np.array([epochs]))
    expected = accuracy(errors, nees, max(1.0, round(1.0 / dt)), axes)
    assert {key: value.item() for key, value in found.items()} == pytest.approx(
        {key: float(value) for key, value in expected.items()}, rel=1e-12
    )
    assert not tally.sums[[0, 2]].any()
    assert tally.errors.shape[1] <= epochs  # however many there are in a second


def test_an_error_without_a_number_is_a_divergence_for_good():
    tally = Tally(1, 3)
    for k, x in enumerate([0.0] * 12 + [np.nan] + [1.0] * 5):
        count(tally.sums[0], tally.errors[0], 1, tally.interval, k, x, 0.0, 0.0, 3.0)
    assert tally.metrics(np.array([0]), np.array([18]))["divergence_rate"] == 1.0
