"""Tests of readings: values and scenes with mistakes undone, and findings on them."""

from dataclasses import replace

import numpy as np

from mmwave_env.localization.readings import AS_IT_IS, ELEVATION, RANGE, Mistake, scaled, values_of
from mmwave_env.models.scene import SCENES
from tests.localization.errors import readings

READING = readings(1, epochs=10)[0]


def test_an_undone_mistake_scales_values_and_the_likelihood_of_the_file():
    halved = READING.without(Mistake("ranges are doubled", "halve them", scaled([RANGE], 0.5, 1.0)))
    z = READING.log.measurement
    np.testing.assert_array_equal(halved.log.measurement[:, RANGE], 1.0 + 0.5 * z[:, RANGE])
    count = values_of(READING.log)[:, RANGE].sum()
    assert halved.log_scale == count * np.log(0.5)
    later = halved.without(Mistake("angles are in degrees", "divide", scaled([ELEVATION], 0.1)))
    np.testing.assert_array_equal(
        later.log.sigma[:, ELEVATION], 0.1 * READING.log.sigma[:, ELEVATION]
    )
    assert later.log_scale == halved.log_scale + count * np.log(0.1)
    finding = later.finding([])
    assert finding.hypothesis == "ranges are doubled; angles are in degrees"
    assert finding.cure == "halve them; then divide" and finding.scene is None


def test_a_finding_contains_the_corrected_scene():
    moved = replace(SCENES["street"], base_station_m=(1.0, 2.0, 3.0))
    reading = READING.without(
        Mistake("it moved", "move it back", lambda r: r._replace(scene=moved))
    )
    assert reading.finding([]).scene == moved
    assert READING.finding([]).hypothesis == AS_IT_IS and READING.finding([]).worst_anchor is None
