"""A log without anchor numbers, as it is typed: simulated, localized, and what goes wrong."""

import json

import pytest

from mmwave_env.models.scene import read_scene
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import LOGS

RIDE = LOGS / "canyon28_vehicle"


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """The folder of a recording whose paths nobody has named, with false ones among them."""
    folder = tmp_path_factory.mktemp("hidden")
    shown = succeed("simulate", "--data", RIDE, "--radio", "standard", "--unassociated",
                    "--false-paths", "5", "--out", folder)  # fmt: skip
    assert shown == f"written to {folder}/: log.csv, scene.json, truth.tum\n"
    return folder


def options(folder, *more):
    return (
        "localize", folder / "log.csv", "--scene", folder / "scene.json", "--truth",
        folder / "truth.tum", "--radio", "standard", "--speed", "auto", *more,
    )  # fmt: skip


def test_a_simulated_log_has_no_anchors_and_more_paths(hidden):
    header, *lines = (hidden / "log.csv").read_text().splitlines()
    assert "anchor" not in header and len(lines) == 300 + 120 * 5
    assert read_scene(hidden / "scene.json").anchors_m.shape == (3, 3)
    made_by = (hidden / "truth.tum").read_text().splitlines()[0]
    assert "--unassociated" in made_by and "--false-paths 5" in made_by


def test_the_command_says_what_was_associated(hidden, tmp_path):
    shown = succeed(*options(hidden, "--associate", "--json", tmp_path / "track.json"))
    figures = json.loads((tmp_path / "track.json").read_text())
    found = figures["association"]
    assert found["paths"] == 900 and found["without_track"] == {"epochs": 0, "paths": 0}
    assert found["false"] == 900 - sum(found["associated"].values())
    assert f"- 900 paths, {found['false']} of them false; the track was found once\n" in shown
    for name, paths in found["associated"].items():
        assert f"| {name} | {paths} | {found['missed'][name]} |\n" in shown
        assert paths + found["missed"][name] == 120
    with_labels = succeed(*options(RIDE, "--json", tmp_path / "labelled.json"))
    assert "paths" not in with_labels
    labelled = json.loads((tmp_path / "labelled.json").read_text())
    assert "association" not in labelled
    ates = [f["truth"]["tracks"]["filtered"]["ate_m"] for f in (figures, labelled)]
    assert ates[0] < 1.1 * ates[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "found no anchor in time_s.*expected anchor; mmwave-loc localize --associate does"),
        (("--associate", "--diagnose"), "diagnose: found with --associate, expected rows with an"),
    ],
)
def test_what_makes_no_sense_is_refused(hidden, words, message):
    assert_one_clear_line(command(*options(hidden, *words)), message)


def test_false_paths_among_rows_with_anchors_are_refused(tmp_path):
    for words, message in [
        (("--false-paths", "3"), "false-paths: found 3, expected 0 or more, with --unassociated"),
        (("--false-paths", "-3", "--unassociated"), "false-paths: found -3, expected 0 or more"),
    ]:
        done = command("simulate", "--scenario", "jam", "--out", tmp_path / "x", *words)
        assert_one_clear_line(done, message)
        assert not (tmp_path / "x").exists()
