"""Tests that likely mistakes in a log are refused or warned of, are diagnosed, and are reported."""

from contextlib import suppress
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from experiments.reporting.log_report import diagnosis_markdown, verdict
from mmwave_env.filters.bank import default_modes
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.contradictions import Contradiction, contradictions
from mmwave_env.localization.diagnosis import AS_IT_IS, diagnose, mistakes
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.readings import Finding, Reading
from mmwave_env.localization.track_scores import group_statistics
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import Origin, read_scene
from policies.rules import by_predicted_speed
from tests.localization.errors import STREET, only, readings
from tests.localization.mistakes import (
    AZIMUTHS,
    FOLDERS,
    MISTAKES,
    ORDERS,
    exchanged,
    linear,
    wrong_log,
)
from tests.logs.by_hand import assert_same
from tests.paths import RIDE, WALK, representative
from tests.refusals import refuses

RADIO = RADIOS["standard"]
MODES = default_modes("standard")
IDS = [folder.name for folder in FOLDERS]
both = pytest.mark.parametrize("folder", FOLDERS, ids=IDS)


def scene_in(folder):
    return read_scene(folder / "scene.json")


def doubts(log, scene, radio=RADIO):
    """Localize a log; return the warnings about contradictions in it."""
    switching = Switching(default_modes(radio.name), by_predicted_speed)
    track = localize(log, scene, radio, switching, window=None)
    groups = group_statistics(track, track.accepted, track.nis)
    return [str(doubt) for doubt in contradictions(log, scene, radio, groups)]


def findings(path, scene, partial=False):
    """Diagnose a log; return the findings, the most likely finding first."""
    log = read_log(path, scene, odometry=False, limits=False)
    return diagnose(Reading(log if partial else log.whole(), scene, RADIO, MODES[1]))


def diagnosed(tmp_path, folder, mistake):
    """Return the most likely finding about the log of a folder with a mistake."""
    return findings(wrong_log(tmp_path, folder, mistake), scene_in(folder))[0]


def assert_diagnosed(best, hypothesis):
    """Check that the best finding is this hypothesis, and that it leaves no contradictions."""
    assert best.hypothesis == hypothesis and not best.contradictions


@both
def test_a_correct_log_is_diagnosed_as_consistent(folder):
    scene = scene_in(folder)
    log = read_log(folder / "log.csv", scene).whole()
    assert not doubts(log, scene)
    best, *others = findings(folder / "log.csv", scene)
    assert_diagnosed(best, AS_IT_IS)
    assert {f.hypothesis for f in others} == {
        m.words for m in mistakes(Reading(log, scene, RADIO, MODES[1]))
    }
    for group, nis in best.nis_per_dof.items():
        assert (0.0 if group == "Doppler" else 0.5) < nis < 2.0


MIRRORED = [  # mistakes with which tracks are mirrored, as anchors on a line allow
    {"azimuths are clockwise from north", "azimuths are counterclockwise from north"},
    {"arrival and departure are exchanged", "azimuths have the other sign"},
]


@pytest.mark.parametrize("folder", representative(FOLDERS, RIDE), ids=IDS)
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_refused_or_causes_a_warning_and_is_diagnosed(tmp_path, folder, name):
    scene = scene_in(folder)
    path = wrong_log(tmp_path, folder, MISTAKES[name])
    with suppress(ValueError, UserWarning):
        log = read_log(path, scene).whole()
        assert log.damage or doubts(log, scene)
    best, second, *_ = findings(path, scene)
    assert_diagnosed(best, name)
    assert best.cure
    assert second.contradictions or {best.hypothesis, second.hypothesis} in MIRRORED


@both
@pytest.mark.parametrize("order", ORDERS, ids=str)
def test_a_wrong_order_of_anchors_causes_a_warning_and_is_diagnosed(folder, order):
    right = scene_in(folder)
    scene = right.with_anchors(right.anchors_m[np.subtract(order, 1)])
    assert doubts(read_log(folder / "log.csv", scene).whole(), scene)
    best = findings(folder / "log.csv", scene)[0]
    # These are the numbers that the log's anchors 1, 2 and 3 have in the wrong scene.
    names = ", ".join(str(order.index(n) + 1) for n in (1, 2, 3))
    assert_diagnosed(best, f"anchors are the scene's {names}")


@both
def test_two_mistakes_in_one_log_are_both_diagnosed(tmp_path, folder):
    zenith = MISTAKES["elevation is a zenith angle"]
    best = diagnosed(tmp_path, folder, lambda c: zenith(exchanged(c)))
    assert not best.contradictions
    mistakes = {"arrival and departure are exchanged", "elevation is a zenith angle"}
    assert set(best.hypothesis.split("; ")) == mistakes


LACKING = {  # mistake -> columns that the log lacks
    AS_IT_IS: ("aoa_elevation_rad", "aod_azimuth_rad"),
    "elevation has the other sign": ("aod_azimuth_rad", "doppler_hz"),
    "azimuth of arrival is in degrees": ("aoa_elevation_rad", "aod_azimuth_rad"),
    "Doppler shift has the other sign": ("aoa_elevation_rad", "aod_azimuth_rad"),
}


@pytest.mark.parametrize("name", representative(LACKING, "elevation has the other sign"))
def test_a_mistake_in_a_log_that_lacks_columns_is_diagnosed(tmp_path, name):
    def change(columns):
        columns = MISTAKES.get(name, dict)(columns)
        return {k: v for k, v in columns.items() if k not in LACKING[name]}

    path = wrong_log(tmp_path, RIDE, change)
    best, *others = findings(path, scene_in(RIDE), partial=True)
    assert_diagnosed(best, name)
    if "doppler_hz" in LACKING[name]:
        assert not any("Doppler" in f.hypothesis for f in others)


def test_a_rotated_frame_is_diagnosed_with_its_angle_and_the_corrected_scene(tmp_path):
    folder = RIDE
    scene = scene_in(folder)
    path = wrong_log(tmp_path, folder, linear(1.0, *AZIMUTHS, offset=0.7))
    assert doubts(read_log(path, scene).whole(), scene)
    best, second, third, *_ = findings(path, scene)
    assert best.shared and second.shared and not best.contradictions and third.contradictions
    assert best.hypothesis.startswith("azimuths are turned by 40.")
    assert best.scene.bearing_deg == pytest.approx(np.degrees(0.7), abs=0.2)
    assert not doubts(read_log(path, best.scene).whole(), best.scene)


@pytest.mark.parametrize(("name", "sign", "degrees"), [
    ("azimuths are compass bearings", -1.0, 60.0),
    ("azimuths are counterclockwise from east", 1.0, 30.0),
])  # fmt: skip
def test_compass_bearings_are_diagnosed_if_the_x_axis_is_known(tmp_path, name, sign, degrees):
    scene = scene_in(RIDE)
    scene = replace(scene, origin=Origin(48.0, 11.0, bearing_deg=60.0))
    mistake = linear(sign, *AZIMUTHS, offset=np.radians(degrees))
    best = findings(wrong_log(tmp_path, RIDE, mistake), scene)[0]
    assert_diagnosed(best, name)


def test_a_log_with_an_hour_without_epochs_is_diagnosed_by_its_longer_part(tmp_path):
    def paused(columns):
        wrong = MISTAKES["angles are in degrees"](columns)
        return wrong | {"time_s": columns["time_s"] + 3600.0 * (columns["time_s"] > 9.0)}

    best = diagnosed(tmp_path, RIDE, paused)
    assert_diagnosed(best, "angles are in degrees")


def test_a_correct_log_with_some_wild_ranges_is_diagnosed_as_consistent(tmp_path):
    def wild(columns):
        late = np.arange(len(columns["toa_s"])) % 30 == 10
        return columns | {"toa_s": columns["toa_s"] + 1e-6 * late}

    best = diagnosed(tmp_path, WALK, wild)
    assert_diagnosed(best, AS_IT_IS)


def test_a_pedestrian_whose_ranges_alone_fit_too_well_suggests_no_other_anchors():
    (reading,) = readings(1, seed=500_009)
    best = diagnose(only(reading, [0, 4, 8, 12]))[0]
    assert best.hypothesis == AS_IT_IS and best.nis_per_dof["anchor 1"] < 0.2


def test_ten_epochs_that_fit_no_hypothesis_are_not_called_consistent(tmp_path):
    def short(columns):
        first = columns["time_s"] < np.unique(columns["time_s"])[10]
        wrong = linear(np.pi / 180.0, "aoa_azimuth_rad")(columns)
        return {name: values[first] for name, values in wrong.items()}

    assert diagnosed(tmp_path, WALK, short).contradictions


def test_the_radio_of_a_log_is_diagnosed_and_the_log_is_not_changed():
    scene = scene_in(RIDE)
    block = read_log(RIDE / "log.csv", scene, limits=False).whole()
    before = deepcopy(block)
    best = diagnose(Reading(block, scene, RADIOS["handset"], MODES[1]))[0]
    assert_diagnosed(best, "radio is standard")
    assert_same(block, before)
    block.visible[:, 0] = False
    with refuses("log"):
        diagnose(Reading(block, scene, RADIO, MODES[1]))


# --- the report: its verdict, its notes and its table

DOUBT = Contradiction("anchor 2", "NIS / dof 9", "0.2 to 5")
FITS = {"anchor 1": 1.1, "anchor 2": 0.6, "Doppler": None}
AS_IS = Finding(AS_IT_IS, FITS, -1.0, [], "", STREET)
WRONG = AS_IS._replace(contradictions=[DOUBT])
TURNED = AS_IS._replace(hypothesis="azimuths are turned", cure="write it", shared=True)
NEGATED = AS_IS._replace(hypothesis="signs differ", cure="negate")
CASES = {  # words of the verdict -> findings
    "The log is consistent as it is.": [AS_IS],
    "The log is consistent if signs differ. It was not changed. To correct it, negate": [
        NEGATED,
        WRONG,
    ],
    "No hypothesis makes the log consistent. anchor 2: found NIS / dof 9, expected": [WRONG],
    "The log looks as if azimuths are turned; protection levels do not hold": [TURNED, AS_IS],
    "is near 1. Even without this: anchor 2: found NIS / dof 9, expected 0.2 to 5. It was not": [
        TURNED._replace(contradictions=[DOUBT]),
        WRONG,
    ],
}


@pytest.mark.parametrize("words", CASES)
def test_the_verdict_is_about_the_best_finding(words):
    assert words in verdict(CASES[words])


def test_notes_stand_between_verdict_and_table():
    findings = [NEGATED, WRONG]
    text = diagnosis_markdown(findings, ["the clock jumps"])
    said, note, table, *_ = text.split("\n\n")
    assert said == verdict(findings) and note == "- the clock jumps"
    rows = [line.split(" | ") for line in table.splitlines()]
    assert rows[2] == ["| signs differ", "0.6", "-", "yes |"]
    assert rows[3] == ["| as it is", "0.6", "-", "no |"]
    assert "\n\n- " not in diagnosis_markdown([AS_IS], [])


def test_a_shared_error_needs_no_table_of_hypotheses_that_do_not_see_it():
    assert "| as it is" not in diagnosis_markdown([TURNED, AS_IS], [])
