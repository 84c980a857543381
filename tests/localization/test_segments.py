"""Tests of the segments of a log: where they begin and end, and how gaps are handled."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.localization.segments import segments
from mmwave_env.models.layout import Layout
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.logs.by_hand import block_of, cut
from tests.refusals import refuses

STREET = SCENES["street"]
HANDSET = RADIOS["handset"]
LINK_1, LINK_2, DOPPLER, ODOMETRY = range(4)


def log(time_s, groups_seen, odometry=True):
    """Return a log with two anchors; ``groups_seen`` has, for each epoch, the visible groups."""
    layout = Layout(2, odometry)
    visible = np.zeros((len(time_s), len(layout.groups)), bool)
    for epoch, groups in enumerate(groups_seen):
        visible[epoch, list(groups)] = True
    return block_of(layout, np.array(time_s, float), np.ones((len(time_s), layout.size)), visible)


def pieces_of(*blocks):
    """Return (times, segment, begins, skipped, dropped) of each block that ``segments`` yields."""
    return [
        (p.time_s.tolist(), p.segment, p.begins, p.skipped, p.dropped)
        for p in segments(blocks, STREET, HANDSET)
    ]


# visible groups of an epoch; only the link of anchor 1 determines a position (a fix)
FIX = (LINK_1,)
OTHER = (LINK_2,)
NOTHING = ()


def test_a_gap_in_time_ends_a_segment():
    block = log([0, 1, 1 + GAP_S, 16.5 + GAP_S + 0.1], [FIX] * 4)
    assert pieces_of(block) == [([0, 1, 16], 0, True, 0, 0), ([31.6], 1, True, 0, 0)]


def test_epochs_without_a_link_belong_to_a_segment_until_the_gap_is_too_long():
    block = log(range(30), [NOTHING] * 2 + [FIX] + [(DOPPLER,)] * 20 + [OTHER] * 3 + [FIX] * 4)
    assert pieces_of(block) == [
        (list(range(2, 18)), 0, True, 2, 8),  # epoch 18 is more than 15 s after the link in epoch 2
        ([26, 27, 28, 29], 1, True, 2, 8),
    ]


def test_any_link_or_odometry_continues_a_segment():
    groups = [FIX] + [NOTHING] * 9 + [OTHER] + [NOTHING] * 9 + [(ODOMETRY,)] + [NOTHING] * 9
    assert pieces_of(log(range(30), groups)) == [(list(range(30)), 0, True, 0, 0)]


def test_a_segment_begins_where_the_log_marks_a_restart():
    block = log(range(8), [FIX] * 4 + [OTHER] + [FIX] * 3)
    block.restarts[[0, 3, 4]] = True  # epoch 0 begins a segment anyway
    expected = [([0, 1, 2], 0, True, 0, 0), ([3], 1, True, 0, 1), ([5, 6, 7], 2, True, 0, 1)]
    assert pieces_of(block) == expected


def test_a_log_without_a_line_of_sight_is_refused():
    with refuses("log"):
        pieces_of(log(range(30), [OTHER] * 30))


@settings(deadline=None)
@given(
    steps=st.lists(st.sampled_from([1, 5, 10, 20]), min_size=1, max_size=40),
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=5),
    data=st.data(),
)
def test_segments_do_not_depend_on_the_sizes_of_blocks(steps, sizes, data):
    kinds = st.sampled_from([FIX, OTHER, NOTHING, (ODOMETRY,)])
    n = len(steps)
    groups = data.draw(st.lists(kinds, min_size=n, max_size=n))
    whole = log(np.cumsum(steps), [FIX, *groups[1:]])

    def epochs(pieces):
        return [(t, p[1], p[2] and t == p[0][0]) for p in pieces for t in p[0]]

    expected = pieces_of(whole)
    pieces = pieces_of(*cut(whole, sizes))
    assert epochs(pieces) == epochs(expected) and pieces[-1][3:] == expected[-1][3:]
    dropped = n - sum(len(p[0]) for p in pieces)
    assert pieces[-1][4] == dropped
