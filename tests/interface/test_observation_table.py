"""Tests of the table of features that defines an observation: space, documentation, scales."""

import numpy as np
import pytest
from gymnasium import spaces

import mmwave_env  # noqa: F401  registers the environment
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import modes_from
from mmwave_env.interface.features import feature_kinds
from mmwave_env.interface.observation import BELIEFS, OBSERVATIONS, Observation
from mmwave_env.models.layout import Layout

PIPELINES = {
    "default": Pipeline(modes_from(None), Layout()),
    "odometry": Pipeline(modes_from(None), Layout(odometry=True)),
    "one anchor": Pipeline(modes_from(["ukf"]), Layout(1)),
    "three modes": Pipeline(modes_from(["ekf", "ukf", "ckf"]), Layout(5, True), planar=True),
}
COMING = ("coming ", "preference ")  # features whose names begin like this use the coming epoch

every_pipeline = pytest.mark.parametrize("pipeline", PIPELINES.values(), ids=PIPELINES)
every_kind = pytest.mark.parametrize("kind", OBSERVATIONS)


def scales(table):
    return np.array([(f.mean, f.deviation) for f in table.features]).T


@every_kind
@every_pipeline
def test_the_table_defines_the_observation_space(pipeline, kind):
    table = Observation(pipeline, kind)
    space = table.space
    assert isinstance(space, spaces.Box) and space.dtype == np.float32
    assert space.shape == (len(table),) == (len(set(table.names)),)
    mean, deviation = scales(table)
    limits = np.array([(f.low, f.high) for f in table.features]).T
    bounds = np.clip((limits - mean) / deviation, -10.0, 10.0)
    np.testing.assert_allclose([space.low, space.high], bounds, rtol=1e-6)
    assert (space.low < space.high).all() and space.is_bounded()
    assert (deviation > 0.0).all() and all(f.meaning for f in table.features)


@every_pipeline
def test_the_observation_called_prior_lacks_what_modes_compute_for_the_coming_epoch(pipeline):
    full = Observation(pipeline).names
    prior = Observation(pipeline, "prior").names
    assert prior == [name for name in full if not name.startswith(COMING)]
    assert len(prior) < len(full)


@every_kind
@every_pipeline
def test_the_documented_table_lists_every_feature_in_order(pipeline, kind):
    table = Observation(pipeline, kind)
    head, rule, *rows = table.table().splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [(int(number), name) for number, name, *_ in cells] == list(enumerate(table.names))
    assert all(len(row) == 8 == head.count("|") - 1 == rule.count("|") - 1 for row in cells)


@every_pipeline
@pytest.mark.parametrize("beliefs", BELIEFS)
def test_reading_a_feature_inverts_its_standardization(pipeline, beliefs):
    """Check random values up to rounding, and integers exactly."""
    table = Observation(pipeline, beliefs=beliefs)
    integers = np.arange(-30.0, 31.0)
    values = np.append(np.random.default_rng(0).uniform(-40.0, 40.0, 1000), integers)
    mean, deviation = scales(table)
    observations = ((values[:, None] - mean) / deviation).astype(np.float32)
    for i, feature in enumerate(table.features):
        read = table.read(observations, feature.name)
        assert read.dtype == np.float64
        rounding = np.spacing(np.abs(observations[:, i])) * deviation[i]
        assert (np.abs(read - values) <= 2.0 * rounding + 1e-12).all()
        assert table.read(observations[0], feature.name) == read[0]
        np.testing.assert_array_equal(read[1000:], integers, err_msg=feature.name)


def test_every_kind_in_the_file_of_kinds_has_features():
    tables = [Observation(PIPELINES["odometry"], "signed", beliefs) for beliefs in BELIEFS]
    kinds = {feature.kind for table in tables for feature in table.features}
    assert kinds == feature_kinds().keys()
