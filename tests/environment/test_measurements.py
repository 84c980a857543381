"""Tests of the argument ``measurements``, for receivers that do not measure every quantity."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.recorded import TrackSource
from mmwave_env.datasets.samples import read_track, sample_folder
from mmwave_env.models.layout import MEASUREMENTS, Layout
from mmwave_env.task import task_from
from tests.filters.tracks import around_a_block, assert_same_fields, replay, sampled, street_source
from tests.refusals import refuses

SUBSETS = [("range", "azimuth"), ("azimuth", "elevation", "departure"), ("departure", "doppler")]
NOISY = {  # name -> arguments of a task whose source draws noise
    "simulated": {},
    "odometry": {"odometry": True},
    "random streets": {"scene": "random"},
    "a trajectory": {"scenario": around_a_block()},
    "recorded": {"episodes": "canyon28_vehicle"},
}
SOURCES = NOISY | {"log": {"episodes": sample_folder("canyon28_vehicle")}}


def rows_of(subset, layout):
    """Return a mask (rows,) of the measurement rows that belong to a subset of quantities."""
    link = [name in subset for name in MEASUREMENTS[:4]]
    return np.array([*link * layout.anchors, "doppler" in subset, *[True] * 2 * layout.odometry])


@pytest.mark.parametrize("arguments", SOURCES.values(), ids=SOURCES)
@pytest.mark.parametrize("subset", [*SUBSETS, MEASUREMENTS], ids=" ".join)
def test_the_measured_rows_equal_the_rows_of_the_complete_episode(arguments, subset):
    arguments = arguments | {"episode_steps": 40}
    some = sampled(task_from(**arguments, measurements=subset[::-1]).source, 4)
    whole = sampled(task_from(**arguments, measurements=None).source, 4)
    layout = some.layout
    assert layout == Layout(whole.layout.anchors, whole.layout.odometry, partial=True)
    seen = np.repeat(whole.usable, whole.layout.widths, axis=1) & rows_of(subset, layout)
    assert_array_equal(np.isfinite(some.measurement), seen)
    assert_array_equal(some.measurement[seen], whole.measurement[seen])
    assert_allclose(some.sigma[seen], whole.sigma[seen], rtol=1e-12)
    assert_array_equal(some.usable, np.logical_or.reduceat(seen, layout.starts, axis=1))
    fields = ("truth_position_m", "truth_velocity_mps", "prior_mean", "doppler_spread_hz")
    assert_same_fields(some, whole, *fields)
    assert some.nonfinite == 0


def test_all_subsets_share_one_compiled_simulation():
    sources = [street_source(epochs=40, measurements=subset) for subset in SUBSETS]
    worlds = {id(source.world) for source in sources}
    assert len(worlds) == 1
    assert not np.array_equal(*[source.episode(5).visible for source in sources[1:]])


@pytest.mark.parametrize(
    "asked",
    [[], ["elevation"], ["doppler", "elevation"], ["range", "snr"], "range", 3, [None]],
    ids=str,
)
def test_subsets_that_do_not_determine_a_position_and_unknown_names_are_refused(asked):
    for arguments in ({}, {"episodes": "canyon28_vehicle"}):
        with refuses("measurements"):
            task_from(**arguments, measurements=asked)


def test_a_custom_source_decides_what_is_measured():
    episode = street_source(epochs=5).episode(1)
    with refuses("measurements"):
        task_from(episodes=replay(episode), measurements=["range"])
    some = replay(episode.only(["range"]))
    assert task_from(episodes=some).pipeline.layout.partial


@pytest.mark.parametrize("needs", [{"measurements": ["range"]}, {"clock": "offset"}], ids=str)
def test_a_track_without_ranges_is_refused_where_they_are_needed(needs):
    track = read_track("canyon28_vehicle")
    track.measurement[:, : track.layout.doppler : 4] = np.nan
    with refuses(*needs):
        TrackSource(track, "handset", **needs)
