"""Tests of the warnings for logs that contradict their scene, and of the option --diagnose."""

import json
import re

import numpy as np
import pytest

from mmwave_env.logs.tum import read_tum
from tests.cli import command
from tests.commands.localizing import RIDE, options
from tests.localization.mistakes import MISTAKES, read_columns, write_columns


@pytest.fixture(scope="module")
def downlink(tmp_path_factory):
    """Return a copy of the ride's log with angles of arrival at the user, as in a downlink."""
    log = tmp_path_factory.mktemp("downlink") / "log.csv"
    mistake = MISTAKES["arrival is at the user, as in a downlink"]
    write_columns(log, mistake(read_columns(RIDE / "log.csv")))
    return log


def test_each_contradiction_is_shown_as_a_warning_and_written_to_json(tmp_path, downlink):
    words = options(downlink, "--speed", "auto", "--radio", "standard", folder=RIDE)
    done = command("localize", *words, "--json", tmp_path / "found.json")
    assert done.returncode == 0 and "NIS / dof" in done.stdout
    lines = done.stderr.splitlines()
    assert re.fullmatch(
        r"warning: anchor 1: found .*, expected .*; --diagnose tries likely mistakes", lines[0]
    )
    said = json.loads((tmp_path / "found.json").read_text())["contradictions"]
    assert len(said) == len(lines)
    for line, contradiction in zip(lines, said, strict=True):
        assert "{group}: found {found}, expected {expected};".format(**contradiction) in line


def test_a_diagnosis_names_the_mistake_and_writes_no_track(tmp_path, downlink):
    before, file = downlink.read_bytes(), tmp_path / "found.json"
    words = options(downlink, "--radio", "standard", "--diagnose", "--json", file, folder=RIDE)
    done = command("localize", *words)
    assert done.returncode == 0 and done.stderr == "" and downlink.read_bytes() == before
    name = "arrival is at the user, as in a downlink"
    assert f"\nThe log is consistent if {name}." in done.stdout
    cure = "exchange the columns of aoa_azimuth and aod_azimuth, negate aoa_elevation"
    assert f"To correct it, {cure} (docs/data.md)." in done.stdout
    diagnosis = json.loads(file.read_text())
    assert "--diagnose" in diagnosis["command"] and "numba" in diagnosis["versions"]
    first, *others = diagnosis["hypotheses"]
    assert first["hypothesis"] == name and first["contradictions"] == []
    assert all(other["contradictions"] for other in others)


def test_a_log_that_is_refused_can_be_diagnosed(tmp_path):
    log = tmp_path / "log.csv"
    write_columns(log, MISTAKES["angles are in degrees"](read_columns(RIDE / "log.csv")))
    words = options(log, "--radio", "standard", folder=RIDE)
    refusal = command("localize", *words, "--speed", "auto")
    assert refusal.returncode == 2
    assert "if the value is in degrees, name the column aoa_azimuth_deg; mmwave" in refusal.stderr
    done = command("localize", *words, "--diagnose")
    assert "\nThe log is consistent if angles are in degrees." in done.stdout


@pytest.mark.slow
def test_a_diagnosis_says_that_a_log_is_consistent_or_that_no_mistake_explains_it():
    words = options(RIDE / "log.csv", "--radio", "standard", "--diagnose", folder=RIDE)
    assert "\nThe log is consistent as it is." in command("localize", *words).stdout
    other = [*map(str, (RIDE / "log.csv", "--scene", "street", "--diagnose"))]
    assert "\nNo hypothesis makes the log consistent." in command("localize", *other).stdout


def test_a_diagnosis_reports_facts_about_the_log(tmp_path):
    file = tmp_path / "facts.json"
    words = options(RIDE / "log.csv", "--radio", "standard", folder=RIDE)
    done = command("localize", *words, "--truth", RIDE / "truth.tum", "--diagnose", "--json", file)
    columns = read_columns(RIDE / "log.csv")
    times, facts = np.unique(columns["time_s"]), json.loads(file.read_text())["facts"]
    assert facts["epochs"] == len(times) and facts["problems"] == []
    assert (facts["first_s"], facts["last_s"]) == (times[0], times[-1])
    assert facts["step_s"] == pytest.approx(np.median(np.diff(times)))
    for anchor, fact in enumerate(facts["anchors"], start=1):
        of = columns["anchor"] == anchor  # links that were not measured have empty cells
        assert fact["seen"] == np.isfinite(columns["snr_db"][of]).sum()
    poses = read_tum(RIDE / "truth.tum")
    moved = np.linalg.norm(np.diff(poses.position_m, axis=0), axis=1) / np.diff(poses.time_s)
    assert facts["speed_mps"]["max"] == pytest.approx(moved.max(), rel=0.05)
    assert "no problems found" in done.stdout and "m/s on average" in done.stdout
