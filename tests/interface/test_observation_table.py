"""Tests of the observation's table of features: its space, documentation and scales."""

import math

import numpy as np
import pytest
from gymnasium import spaces

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.filters.bank import best_bank, modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.observation import BELIEFS, Observation, feature_scales
from mmwave_env.models.layout import Layout
from tests.refusals import refuses

PIPELINES = {
    "default": Pipeline(modes_from(None), Layout()),
    "odometry": Pipeline(modes_from(None), Layout(odometry=True)),
    "one anchor": Pipeline(modes_from(["ukf"]), Layout(1)),
    "three modes": Pipeline(modes_from(["ekf", "ukf", "ckf"]), Layout(5, True), planar=True),
}
COMING = ("coming ", "preference ")

every_pipeline = pytest.mark.parametrize("pipeline", PIPELINES.values(), ids=PIPELINES)
every_kind = pytest.mark.parametrize("kind", ["full", "prior"])


def names(table):
    return [feature.name for feature in table.features]


# --- the table


@every_kind
@every_pipeline
def test_the_table_defines_the_observation_space(pipeline, kind):
    table = Observation(pipeline, kind)
    space = table.space
    assert isinstance(space, spaces.Box) and space.dtype == np.float32
    assert space.shape == (len(table),) == (len(set(names(table))),)
    mean, deviation = np.array(table.scales).T
    limits = np.array([(f.low, f.high) for f in table.features]).T
    bounds = np.clip((limits - mean) / deviation, -10.0, 10.0)
    np.testing.assert_allclose([space.low, space.high], bounds, rtol=1e-6)
    assert (space.low < space.high).all() and space.is_bounded()
    assert (deviation > 0.0).all() and all(f.meaning for f in table.features)


@every_pipeline
def test_the_observation_called_prior_leaves_out_how_modes_explain_the_coming_epoch(pipeline):
    full, prior = names(Observation(pipeline)), names(Observation(pipeline, "prior"))
    assert prior == [name for name in full if not name.startswith(COMING)]
    assert len(prior) < len(full)


@every_kind
@every_pipeline
def test_the_documented_table_lists_every_feature_in_order(pipeline, kind):
    table = Observation(pipeline, kind)
    head, rule, *rows = table.table().splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [(int(number), name) for number, name, *_ in cells] == list(enumerate(names(table)))
    assert all(len(row) == 8 == head.count("|") - 1 == rule.count("|") - 1 for row in cells)


def observed(table, values):
    """Return observations (n, features) in which every feature has these values (n,)."""
    mean, deviation = np.array(table.scales).T
    return ((np.asarray(values)[:, None] - mean) / deviation).astype(np.float32)


@every_pipeline
@pytest.mark.parametrize("beliefs", BELIEFS)
def test_reading_a_feature_inverts_its_standardization(pipeline, beliefs):
    """Check also that integers are read exactly."""
    table, whole = Observation(pipeline, beliefs=beliefs), np.arange(-30.0, 31.0)
    values = np.append(np.random.default_rng(0).uniform(-40.0, 40.0, 1000), whole)
    observations = observed(table, values)
    for i, feature in enumerate(table.features):
        read = table.read(observations, feature.name)
        assert read.dtype == np.float64
        known = np.spacing(np.abs(observations[:, i])) * table.scales[i].deviation
        assert (np.abs(read - values) <= 2.0 * known + 1e-12).all()
        assert table.read(observations[0], feature.name) == read[0]
        np.testing.assert_array_equal(read[1000:], whole, err_msg=feature.name)


# --- the constants


@pytest.mark.parametrize("beliefs", BELIEFS)
@pytest.mark.parametrize(
    "pipeline",
    [
        PIPELINES["one anchor"],
        Pipeline(best_bank().modes, Layout()),
        Pipeline((Mode("slow feet"), Mode("fast wheels")), Layout(5), True),
    ],
)
def test_every_feature_of_any_task_is_of_a_kind_that_has_scales(pipeline, beliefs):
    table = Observation(pipeline, "signed", beliefs)
    kinds = {feature.kind for feature in table.features}
    assert kinds <= feature_scales().keys()
    assert all(math.isfinite(mean) and deviation > 0.0 for mean, deviation in table.scales)
    assert all("1" not in kind and "feet" not in kind and "ukf" not in kind for kind in kinds)


def test_every_kind_that_has_scales_has_a_feature():
    tables = [Observation(PIPELINES["odometry"], "signed", beliefs) for beliefs in BELIEFS]
    kinds = {feature.kind for table in tables for feature in table.features}
    assert kinds == feature_scales().keys()


def test_reading_an_unknown_feature_is_refused():
    table = Observation(PIPELINES["default"], "prior")
    with refuses("color", error=KeyError):
        table.read(np.zeros((1, len(table)), np.float32), "color")
