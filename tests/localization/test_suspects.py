"""Tests of kinds of errors, each of which undoes its own, and of readings with mistakes undone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.localization.readings import (
    AZIMUTH,
    DEPARTURE,
    ELEVATION,
    RANGE,
    Mistake,
    scaled,
    values_of,
)
from mmwave_env.localization.shared_errors import SharedError, suspects
from tests.localization.errors import drifting, late, moved, only, readings, shifted, tilted, turned

READING = readings(1, epochs=10)[0]
EVERY = {suspect.name: suspect for suspect in suspects(READING)}
UNDONE = {  # name -> error of size 2
    "azimuths are turned": turned(2.0),
    "azimuths of arrival are turned": shifted(AZIMUTH, by=np.radians(2.0)),
    "azimuths of departure are turned": shifted(DEPARTURE, by=np.radians(2.0)),
    "elevations are too large": tilted(2.0),
    "ranges are too long": late(2.0),
    "the user's clock drifts: ranges grow too long": drifting(2.0),
    "ranges of anchor 3 are too long": shifted(slice(8, 9), by=2.0),
    "anchor 2 is away from its place": moved(1, 2.0, 2.0, 0.0),
    "anchor 2 is higher than in the scene": moved(1, 0.0, 0.0, 2.0),
    "several errors": lambda r: late(2.0)(turned(2.0)(tilted(2.0)(drifting(2.0)(r)))),
}


@pytest.mark.parametrize("name", UNDONE)
def test_a_suspect_undoes_its_error(name):
    wrong = UNDONE[name](READING)
    suspect = EVERY[name]
    corrected = suspect.correct(wrong, np.full(suspect.parameters, 2.0))
    assert_allclose(corrected.log.measurement, READING.log.measurement, atol=1e-12)
    assert_allclose(corrected.scene.anchors_m, READING.scene.anchors_m, atol=1e-12)


def test_the_corrected_scene_states_bearing_and_offsets():
    joint = EVERY["several errors"]
    scene = joint.correct(READING, np.array([2.0, 3.0, 4.0, 5.0])).scene
    assert scene.bearing_deg == 3.0 and scene.range_offset_m == (2.0, 2.0, 2.0)
    again = EVERY["ranges of anchor 2 are too long"]
    offset = again.correct(READING._replace(scene=scene), np.array([0.5]))
    assert offset.scene.range_offset_m == (2.0, 2.5, 2.0)


def test_a_scaled_doppler_shift_corrects_the_carrier():
    corrected = EVERY["Doppler shifts are too large"].correct(READING, np.array([10.0]))
    assert corrected.scene.hz_per_mps == pytest.approx(1.1 * READING.scene.hz_per_mps)


def test_a_base_station_moves_with_its_images():
    name = "the base station with its images is away from its place"
    scene = EVERY[name].correct(READING, np.array([1.0, 0.0])).scene
    x = READING.scene.anchors_m[:, 0]
    assert (scene.anchors_m[:, 0] - x).tolist() == [1.0, 1.0, -1.0]  # one wall across x


def named(log):
    return {suspect.name for suspect in suspects(READING._replace(log=log))}


def test_what_no_log_can_show_is_not_looked_for():
    log = READING.log
    single = log.visible.copy()
    single[:, 1:3] = False
    assert named(replace(log, visible=single)) == {
        "azimuths of arrival are turned",
        "azimuths of departure are turned",
        "elevations are too large",
        "Doppler shifts are too large",
    }
    clock = replace(log, layout=replace(log.layout, clock="offset"))
    of_clock = {"ranges are too long", "the user's clock drifts: ranges grow too long"}
    assert named(log) - named(clock) == {*of_clock, "several errors"}
    assert named(only(READING, [0, 4, 8]).log) == of_clock


def test_sentences_give_sizes_deviations_and_units():
    theta = np.array([1.0, -2.125])
    place = SharedError(EVERY["anchor 1 is away from its place"], theta, abs(theta))
    assert str(place).endswith("by (1.00, -2.12) ± (1.00, 2.12) m")
    angle = SharedError(EVERY["azimuths are turned"], theta[:1], theta[:1])
    assert str(angle) == "azimuths are turned by 1.00 ± 1.00 degrees"
    late = EVERY["ranges are too long"]
    assert str(SharedError(late, theta[1:], -theta[1:])) == "ranges are too short by 2.12 ± 2.12 m"


def test_an_undone_mistake_scales_values_and_the_likelihood_of_the_file():
    halved = READING.without(Mistake("ranges are doubled", "halve them", scaled([RANGE], 0.5, 1.0)))
    z = READING.log.measurement
    assert_array_equal(halved.log.measurement[:, RANGE], 1.0 + 0.5 * z[:, RANGE])
    count = values_of(READING.log)[:, RANGE].sum()
    assert halved.log_scale == count * np.log(0.5)
    later = halved.without(Mistake("angles are in degrees", "divide", scaled([ELEVATION], 0.1)))
    assert_array_equal(later.log.sigma[:, ELEVATION], 0.1 * READING.log.sigma[:, ELEVATION])
    assert later.log_scale == halved.log_scale + count * np.log(0.1)
    finding = later.finding([])
    assert finding.hypothesis == "ranges are doubled; angles are in degrees"
    assert finding.cure == "halve them; then divide" and finding.scene is READING.scene
