"""Tests that our filters agree with filterpy over episodes, and with the textbook at anchors."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmwave_env.filters import Gate, Mode, Pipeline, ekf, textbook
from mmwave_env.filters.filterpy_reference import filterpy_pipeline
from mmwave_env.filters.modes import ALGORITHMS as FUNCTIONS
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import NEAREST_M, exact_rows
from mmwave_env.models.scene import SCENES
from tests.filters.gated_textbook import groups_of
from tests.filters.problems import HZ_PER_MPS, Problem, assert_same, derivative
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
every_algorithm = pytest.mark.parametrize("algorithm", ALGORITHMS)


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
        assert_allclose(twin[part], ours[part], rtol=1e-7, atol=1e-7)
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


@every_algorithm
@pytest.mark.parametrize("walls", [(), SCENES["street"].walls], ids=["one anchor", "three anchors"])
def test_episodes_with_odometry_and_one_or_three_anchors_agree_with_filterpy(algorithm, walls):
    scene = replace(SCENES["street"], walls=walls)
    episodes = simulated(1, epochs=100, odometry=True, scene=scene)
    assert_agree(pipeline_of(episodes[0].layout, [algorithm]), episodes)


@every_algorithm
@pytest.mark.parametrize("name", ["adaptive and gated", "robust"])
def test_episodes_with_missing_rows_agree_with_filterpy(algorithm, name):
    rng = np.random.default_rng(1)
    episodes = [some_rows(e, rng, 0.6) for e in simulated(1, epochs=100, odometry=True)]
    assert_agree(pipeline_of(episodes[0].layout, [algorithm], **TUNINGS[name]), episodes)


@every_algorithm
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


# --- right below, above and at an anchor

ANCHORS = np.array([[0.0, 0.0, 10.0], [80.0, 60.0, 12.0], [-50.0, 70.0, 15.0]])
SILENT = {"vertical": [1, 3], "anchor": [1, 2, 3, 12]}  # position -> rows without information
# name -> (prior mean minus first anchor in m, key of SILENT; None if all rows have information)
OFFSETS = {
    "below": ((0.0, 0.0, -8.5), "vertical"),
    "above": ((0.0, 0.0, 20.0), "vertical"),
    "too close to the vertical": ((0.6 * NEAREST_M, -0.6 * NEAREST_M, -8.5), "vertical"),
    "at the anchor": ((0.0, 0.0, 0.0), "anchor"),
    "too close to the anchor": ((0.3 * NEAREST_M, -0.4 * NEAREST_M, 0.5 * NEAREST_M), "anchor"),
    "far enough from the vertical": ((1.2 * NEAREST_M, 0.7 * NEAREST_M, -8.5), None),
    "far enough from the anchor": ((-1.1 * NEAREST_M, 1.2 * NEAREST_M, 0.9 * NEAREST_M), None),
}
everywhere = pytest.mark.parametrize("where", OFFSETS)


def near(where, odometry=False):
    """Return a Problem whose prior mean is at the offset ``where``, about 2 m from the truth."""
    sensor = textbook.Sensor(ANCHORS, HZ_PER_MPS, odometry)
    x = np.array([*(ANCHORS[0] + OFFSETS[where][0]), 3.0, -2.0, 0.1, 20.0])
    scale = np.array([3.0, 3.0, 1.0, 1.0, 1.0, 0.3, 50.0])
    factor = scale[:, None] * (np.eye(7) + np.tril(np.full((7, 7), 0.2), -1))
    sigma = np.array([0.5, 0.05, 0.05, 0.05] * 3 + [50.0] + [0.5, 0.1] * odometry)
    z = sensor.h(x + factor @ [0.5, -0.3, 0.4, 0.2, 0.1, -0.2, 0.3])
    visible = np.ones(len(groups_of(sensor)), bool)
    return Problem(x, factor @ factor.T, sensor, z, sigma**2, visible)


@pytest.mark.parametrize("algorithm", FUNCTIONS)
@everywhere
@pytest.mark.parametrize("odometry", [False, True], ids=["radio", "odometry"])
@pytest.mark.parametrize("gate", [Gate(None), Gate(0.99), Gate(0.99, robust=True)], ids=str)
def test_an_update_near_an_anchor_equals_the_textbook(algorithm, where, odometry, gate):
    problem = near(where, odometry)
    assert_same(
        problem.ours(FUNCTIONS[algorithm], gate),
        problem.textbook(textbook.METHODS[algorithm], gate),
        rtol=1e-6,  # next to an anchor, angles change by a thousand radians per meter
    )


@everywhere
def test_jacobian_rows_of_undefined_angles_are_zero_and_other_rows_are_derivatives(where):
    problem = near(where)
    _, lost = OFFSETS[where]
    s = problem.sensor
    x = problem.x
    silent = SILENT.get(lost, [])
    assert np.flatnonzero(s.silent(x)).tolist() == silent
    H = s.jacobian(x)
    assert np.isfinite(H).all() and not H[silent].any()
    if lost is None:
        assert_allclose(H, derivative(s, x, 1e-7), rtol=1e-4, atol=1e-3)


def test_the_exact_measurement_of_a_user_at_an_anchor_is_finite():
    rows = exact_rows([1.0, 2.0, 3.0], [3.0, 0.0, 0.0], [[1.0, 2.0, 3.0]], 93.4, Layout(1))
    assert rows == [0.0, 0.0, 0.0, np.pi, 0.0]
