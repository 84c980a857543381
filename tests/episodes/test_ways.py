"""Windows of ways: who is drawn, and where."""

import numpy as np
import pytest

from mmwave_env.episodes.ways import Ways


def ways_of(*lengths, most=10):
    """Ways on which the first column counts epochs, from 100 times their number on."""
    tables = [100.0 * i + np.tile(np.arange(n)[:, None], 6) for i, n in enumerate(lengths)]
    names = [f"way {i}" for i in range(len(lengths))]
    return Ways(names, [50.0 * i for i in range(len(lengths))], tables, 0.5, most)


def test_all_ways_are_as_likely_and_all_windows_of_one():
    ways = ways_of(10, 12, 40)
    n = 90_000
    which, truth = ways.draw((np.arange(n) + 0.5) / n)
    assert truth.shape == (n, 10, 6) and np.bincount(which).tolist() == [n // 3] * 3
    for way, windows in enumerate((1, 3, 31)):
        starts = truth[which == way, 0, 0] - 100.0 * way
        counts = np.bincount(starts.astype(int))
        assert len(counts) == windows and np.ptp(counts) <= 1
    np.testing.assert_array_equal(np.diff(truth[:, :, 0], axis=1), 1.0)


@pytest.mark.parametrize(("lengths", "epochs"), [((30,), 10), ((7,), 7), ((30, 4), 4)])
def test_an_episode_is_no_longer_than_any_way(lengths, epochs):
    assert ways_of(*lengths).epochs == epochs


def test_a_window_is_found_again():
    ways = ways_of(10, 12, 40)
    which, truth = ways.draw(np.array([0.0, 0.5, 0.999]))
    for way, window in zip(which, truth, strict=True):
        begin = 50.0 * way + 0.5 * (window[0, 0] - 100.0 * way)
        assert ways.find(window[:, :3]) == (f"way {way}", begin, begin + 4.5)
    with pytest.raises(ValueError, match="found positions of no way"):
        ways.find(np.full((10, 3), -1.0))
