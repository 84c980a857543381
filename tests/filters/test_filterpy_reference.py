"""Tests that filterpy's filters and our filters give the same tracks over complete episodes."""

from dataclasses import replace

import numpy as np
import pytest

from mmwave_env.filters import Mode, Pipeline, ekf
from mmwave_env.filters.filterpy_reference import filterpy_pipeline
from mmwave_env.models.layout import Layout
from mmwave_env.models.scene import SCENES
from tests.filters.tracks import (
    assert_same_beliefs,
    pipeline_of,
    sampled,
    simulated,
    some_rows,
    street_source,
    track,
)
from tests.refusals import refuses

EPOCHS = 120
TUNINGS = {
    "plain": {"gate": None, "adaptive": False},
    "adaptive": {"gate": None},
    "gated": {"adaptive": False, "recovery": None},
    "adaptive and gated": {},
    "locked out and recovered": {"sigma_v": 0.1, "sigma_p": 0.01},
    "robust": {"robust": True, "blockage_aware": True},
    "uncoupled": {"coupling": False},
}
ALGORITHMS = ("ekf", "ukf", "ckf")


def both(pipeline, episodes, actions, parts):
    """Return the tracks of our filters and of filterpy's filters, both on plain floats."""
    epochs = len(episodes[0])
    return [
        track(p, episodes, actions, epochs, parts, on_floats=True)
        for p in (pipeline, filterpy_pipeline(pipeline))
    ]


def assert_agree(pipeline, episodes, *more):
    """Assert that our track and filterpy's track are equal; return both with the parts ``more``."""
    ours, twin = both(pipeline, episodes, 0, ("x", "P", "memory", "observation", *more))
    assert_same_beliefs(twin, ours, rtol=1e-9)
    for part in ("memory", "observation"):
        np.testing.assert_allclose(twin[part], ours[part], rtol=1e-7, atol=1e-7)
    return ours, twin


def pairs():
    """Yield all pairs of an algorithm and a tuning; mark all but one pair per tuning as slow."""
    for index, name in enumerate(TUNINGS):
        for a, algorithm in enumerate(ALGORITHMS):
            marks = [] if index % 3 == a else pytest.mark.slow
            yield pytest.param(algorithm, name, marks=marks)


@pytest.mark.parametrize(("algorithm", "name"), [*pairs()])
def test_complete_episodes_agree_with_filterpy(algorithm, name):
    pipeline = pipeline_of(algorithms=[algorithm], **TUNINGS[name])
    more = "P_predicted", "memory.lockout"
    ours, twin = assert_agree(pipeline, simulated(1, EPOCHS), *more)
    predicted = [{"x": t["x"], "P": t["P_predicted"]} for t in (twin, ours)]
    assert_same_beliefs(*predicted, rtol=1e-9)
    if name == "locked out and recovered":
        assert ours["memory.lockout"].max() > 2.0


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("walls", [(), SCENES["street"].walls], ids=["one anchor", "three anchors"])
def test_episodes_with_odometry_and_one_or_three_anchors_agree_with_filterpy(algorithm, walls):
    scene = replace(SCENES["street"], walls=walls)
    episodes = simulated(1, epochs=100, odometry=True, scene=scene)
    assert_agree(pipeline_of(episodes[0].layout, [algorithm]), episodes)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("name", ["adaptive and gated", "robust"])
def test_episodes_with_missing_rows_agree_with_filterpy(algorithm, name):
    rng = np.random.default_rng(1)
    episodes = [some_rows(e, rng, 0.6) for e in simulated(1, epochs=100, odometry=True)]
    assert_agree(pipeline_of(episodes[0].layout, [algorithm], **TUNINGS[name]), episodes)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("clock", ["offset", "free"])
def test_episodes_with_a_user_s_own_clock_agree_with_filterpy(algorithm, clock):
    # filterpy orders sigma points otherwise, which matters if odometry is nonlinear in the velocity
    source = street_source(epochs=60, odometry=algorithm == "ekf", clock=clock)
    assert_agree(pipeline_of(source.layout, [algorithm]), [sampled(source)])


def test_switching_between_filters_gives_the_same_beliefs_as_with_filterpy():
    actions = np.random.default_rng(0).integers(3, size=(60, 2))
    ours, twin = both(pipeline_of(), simulated(2, epochs=60), actions, ("x", "P"))
    assert_same_beliefs(twin, ours, rtol=1e-9)


@pytest.mark.parametrize(
    ("pipeline", "field"),
    [
        (pipeline_of(planar=True), "planar"),
        (Pipeline((Mode("mine", ekf),), Layout(3)), "algorithm of mode 'mine'"),
    ],
    ids=["flat terrain", "own algorithm"],
)
def test_pipelines_that_filterpy_does_not_support_are_refused(pipeline, field):
    with refuses(field):
        filterpy_pipeline(pipeline)
