"""Events in constructed tracks, against definitions written out."""

import numpy as np
import pytest

from experiments.evaluation.events import (
    Windows,
    blockages,
    fast_pull_aways,
    fast_stops,
    pull_aways,
    speeds,
    stops,
    turns,
    velocities,
    visible_links,
)
from experiments.evaluation.seeds import draw_episodes
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES


def row(text):
    return np.array([[float(word) for word in text.split()]])


def epochs(mask):
    return np.flatnonzero(mask[0]).tolist()


# speeds; epochs of stops; epochs of pull-aways
CONSTRUCTED = {
    "a stop and a pull-away": ("3 2 1 0 0 0 1 2", [3], [6]),
    "standing for one epoch": ("3 0 3", [1], [2]),
    "at the limits": ("0.5 0.1 0.51 0.1 0.09 0.5 0.51", [4], [6]),
    "almost standing": ("3 0.2 0.2 3", [], []),
    "almost moving": ("0 0.4 0.4 0", [], []),
    "slowing down for long": ("3 0.4 0.3 0.2 0", [4], []),
    "starting slowly": ("0 0.2 0.3 0.4 0.6 3", [], [4]),
    "begins as it stands": ("0 0 0 3", [], [3]),
    "begins in between": ("0.3 0 0.3 3 0.3 0", [5], [3]),
    "twice": ("3 0 3 0 3", [1, 3], [2, 4]),
    "never": ("2 2 2 2", [], []),
}


@pytest.mark.parametrize("case", CONSTRUCTED)
def test_stops_and_pull_aways_are_where_users_stand_and_move(case):
    text, stopped, pulled = CONSTRUCTED[case]
    assert epochs(stops(row(text))) == stopped
    assert epochs(pull_aways(row(text))) == pulled


def test_a_stop_comes_between_any_two_pull_aways():
    rng = np.random.default_rng(0)
    table = rng.choice([0.0, 0.3, 3.0], (100, 200))
    stopped, pulled = stops(table), pull_aways(table)
    assert not (stopped & pulled).any() and pulled.sum() > 1000
    balance = (pulled * 1 - stopped * 1).cumsum(axis=1)  # no two of a kind in a row
    assert (np.ptp(balance, axis=1) <= 1).all()


def track(headings_deg, speed=2.0):
    """Velocities (1, T, 3) of headings, at a speed or one for each of them."""
    angle = np.radians(np.array(headings_deg, float))
    east, north = np.broadcast_to(speed, angle.shape) * (np.cos(angle), np.sin(angle))
    return np.stack([east, north, np.zeros_like(angle)], axis=-1)[None]


TURNS = {
    "at once": ([0, 0, 90, 90, 90], [2]),
    "along an arc": ([0, 0, 20, 40, 60, 80, 90, 90, 90, 90], [4]),
    "to the right": ([0, 0, 0, -50, -50], [3]),
    "too little": ([0, 0, 44, 44, 44], []),
    "too slowly": (range(0, 180, 14), []),
    "across the west": ([170, 170, -170, -170], []),
    "across the west, enough": ([150, 150, -150, -150], [2]),
    "back": ([0, 0, 180, 180], [2]),
    "two, apart": ([0, 0, 90, 90, 90, 90, 180, 180], [2, 6]),
    "one that goes on": ([0, 0, 90, 180, 270, 270], [2]),
}


@pytest.mark.parametrize("case", TURNS)
def test_turns_are_where_the_heading_has_changed_within_three_seconds(case):
    headings, expected = TURNS[case]
    assert epochs(turns(track(headings), 1.0)) == expected


@pytest.mark.parametrize("angle", [0.3, 1.7, 3.0, 4.4])
def test_turns_do_not_depend_on_where_east_is(angle):
    rng = np.random.default_rng(1)
    way = track(rng.choice([-30.0, 0.0, 30.0, 60.0], 300).cumsum())
    c, s = np.cos(angle), np.sin(angle)
    rotated = way @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    assert epochs(turns(way, 1.0)) == epochs(turns(rotated, 1.0))
    assert len(epochs(turns(way, 1.0))) > 10


def test_who_does_not_move_all_along_does_not_turn():
    headings = [0, 0, 0, 90, 90, 90]
    assert epochs(turns(track(headings), 1.0)) == [3]
    assert epochs(turns(track(headings, [2, 2, 0, 2, 2, 2]), 1.0)) == []
    assert epochs(turns(track(headings, 0.5), 1.0)) == []


def test_a_turn_takes_three_seconds_at_any_rate():
    arc = np.concatenate([np.zeros(40), np.linspace(0.0, 90.0, 40), np.full(40, 90.0)])
    (found,) = epochs(turns(track(arc), 0.1))
    assert arc[found] > 45.0 >= arc[found - 1]
    assert epochs(turns(track(arc), 0.2)) == []  # half as fast


def test_blockage_begins_where_fewer_links_are_visible_than_before():
    assert epochs(blockages(row("3 3 2 2 1 3 3 0 1"))) == [2, 4, 7]
    assert epochs(blockages(row("2 2 3 3"))) == []


def test_recorded_truth_has_what_users_do():
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], "vehicle")
    episodes = draw_episodes(source, range(4))
    velocity = velocities(episodes)
    assert velocity.shape == (4, len(episodes[0]), 3)
    for e, t in np.argwhere(stops(speeds(velocity))):
        assert np.linalg.norm(episodes[e].truth_velocity_mps[t, :2]) < 0.1
    assert turns(velocity, 1.0).sum() > 10  # blocks of a street are short
    links = visible_links(episodes)
    assert links.max() == episodes[0].layout.anchors and links.min() >= 0


# --- epochs around events


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


# --- fast ones


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
