"""Events in constructed tracks, against definitions written out."""

import numpy as np
import pytest

from experiments.evaluation.events import Windows, fast_pull_aways, fast_stops
from mmwave_env.metrics import BURN_IN


def row(text):
    return np.array([[float(word) for word in text.split()]])


def epochs(mask):
    return np.flatnonzero(mask[0]).tolist()


def test_sums_are_those_over_the_epochs_around_each_event():
    rng = np.random.default_rng(2)
    n, T, offsets = 5, 40, np.arange(-4, 6)
    events, values = rng.random((n, T)) < 0.2, rng.normal(size=(n, T))
    sums = Windows.around(events, offsets).sums(values)
    expected = np.zeros((n, len(offsets)))
    for e, t in np.argwhere(events):
        for i, offset in enumerate(offsets):
            if BURN_IN <= t + offset < T:
                expected[e, i] += values[e, t + offset]
    np.testing.assert_allclose(sums, expected, atol=1e-12)


FAST = {
    "a plain one": ("0 0 0 1 3 5", [3]),
    "too short a stop": ("0 0 1 3 5", []),
    "a stop broken": ("0 0 0.4 0 1 3 5", []),
    "lingering": ("0 0 0 0.4 0.4 0.6 3", [5]),
    "at the limits": ("0 0 0 0.5 0.51 2 2.01", [4]),
    "not quite still": ("0.3 0.3 0.3 0.3 3", []),
    "a pedestrian": ("0 0 0 1 1 1 1 1 1 1 3", []),
    "slowly": ("0 0 0 1 1 1 1 1 3", [3]),
    "two": ("0 0 0 4 4 0 0 0 9", [3, 8]),
    "never still": ("1 2 3 4 5", []),
}


@pytest.mark.parametrize("case", FAST)
def test_fast_pull_aways_are_where_they_are_defined_to_be(case):
    text, expected = FAST[case]
    assert epochs(fast_pull_aways(row(text), 1.0)) == expected
    backwards = " ".join(reversed(text.split()))
    last = len(text.split()) - 1
    assert epochs(fast_stops(row(backwards), 1.0)) == sorted(last - t for t in expected)


def test_users_do_not_mix():
    table = np.concatenate([row("0 0 0 1 3 5"), row("0 0 1 3 5 5"), row("9 0 0 0 9 9")])
    assert np.argwhere(fast_pull_aways(table, 1.0)).tolist() == [[0, 3], [2, 4]]


def test_seconds_count_not_epochs():
    slow = row("0 0 0 1 1 1 1 1 3")
    assert epochs(fast_pull_aways(np.repeat(slow, 10, axis=1), 0.1)) == [30]
    assert epochs(fast_pull_aways(slow, 0.1)) == []
    assert epochs(fast_pull_aways(row("0 0 3"), 2.0)) == [2]


def plain_fast_pull_aways(speed):
    """Epoch by epoch, looking back and ahead."""
    found = []
    for t in range(len(speed)):
        moved = max((i + 1 for i in range(t) if speed[i] > 0.5), default=0)  # after the last time
        stood = any((speed[i : i + 3] < 0.3).all() for i in range(moved, t - 2))
        if speed[t] > 0.5 and stood and speed[t : t + 6].max() > 2.0:
            found.append(t)
    return found


def test_fast_pull_aways_of_random_walks_agree_with_looking_back_and_ahead():
    rng = np.random.default_rng(0)
    table = rng.choice([0.0, 0.1, 0.4, 0.6, 3.0], (200, 60), p=[0.5, 0.2, 0.1, 0.1, 0.1])
    found = fast_pull_aways(table, 1.0)
    assert [epochs(row[None]) for row in found] == [plain_fast_pull_aways(row) for row in table]
    assert found.sum() > 200
