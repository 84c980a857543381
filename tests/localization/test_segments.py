"""Tests of the segments of a log: where they begin and end, and how gaps are handled."""

import numpy as np
import pytest

from mmwave_env.localization.segments import segments
from mmwave_env.models.layout import Layout
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.logs.by_hand import damaged, log_with, refuses_log
from tests.refusals import refuses

STREET = SCENES["street"]
HANDSET = RADIOS["handset"]
LINK_1, LINK_2, DOPPLER, ODOMETRY = range(4)


def log(time_s, groups_seen):
    """Return a log with two anchors; ``groups_seen`` has, for each epoch, the visible groups."""
    layout = Layout(2, odometry=True)
    visible = np.zeros((len(time_s), len(layout.groups)), bool)
    for epoch, groups in enumerate(groups_seen):
        visible[epoch, list(groups)] = True
    return log_with(layout, np.array(time_s, float), np.ones((len(time_s), layout.size)), visible)


def times_of(log):
    """Return the times of each segment; the numbers of epochs skipped before and dropped after."""
    parts = segments(log, STREET, HANDSET)
    times = [log.time_s[part.epochs].tolist() for part in parts]
    skipped = parts[0].epochs.start
    return times, skipped, len(log) - skipped - sum(map(len, times))


# visible groups of an epoch; a link determines a position (a fix)
FIX = (LINK_1,)
OTHER = (LINK_2,)
NOTHING = ()


def test_a_gap_in_time_ends_a_segment():
    whole = log([0, 1, 1 + GAP_S, 16.5 + GAP_S + 0.1], [FIX] * 4)
    assert times_of(whole) == ([[0, 1, 16], [31.6]], 0, 0)


def test_epochs_without_a_link_belong_to_a_segment_until_the_gap_is_too_long():
    whole = log(range(30), [NOTHING] * 2 + [FIX] + [(DOPPLER,)] * 23 + [FIX] * 4)
    # epoch 18 is more than 15 s after the link in epoch 2
    assert times_of(whole) == ([[*range(2, 18)], [26, 27, 28, 29]], 2, 8)


def test_any_link_or_odometry_continues_a_segment():
    groups = [FIX] + [NOTHING] * 9 + [OTHER] + [NOTHING] * 9 + [(ODOMETRY,)] + [NOTHING] * 9
    assert times_of(log(range(30), groups)) == ([[*range(30)]], 0, 0)


def test_a_segment_begins_where_the_log_marks_a_restart():
    whole = log(range(8), [FIX] * 4 + [OTHER] + [FIX] * 3)
    whole.restarts[[0, 3, 4]] = True  # epoch 0 begins a segment anyway
    assert times_of(whole) == ([[0, 1, 2], [3], [4, 5, 6, 7]], 0, 0)


def test_a_user_straight_below_an_anchor_is_refused_with_this_reason():
    below = log(range(30), [FIX] * 30)
    below.measurement[:, 2] = np.radians(-88.0)
    with pytest.raises(ValueError, match="straight above or below the user"):
        times_of(below)


def test_a_log_without_a_position_is_refused():
    without = log(range(30), [(DOPPLER,)] * 30)
    with refuses("log"):
        times_of(without)
    with refuses_log("line 7"):
        times_of(damaged(without))
