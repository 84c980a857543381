"""Tests of the option --associate, for logs whose paths have no anchor numbers."""

import json

import numpy as np
import pytest

from mmwave_env.datasets.samples import source_from
from tests.cli import assert_one_clear_line, command, succeed
from tests.commands import localizing
from tests.logs.by_hand import hide_anchors
from tests.paths import LOGS

RIDE = LOGS / "canyon28_vehicle"


@pytest.fixture(scope="module")
def hidden(tmp_path_factory):
    """Return a folder with a log of paths, some of them false, without anchor numbers."""
    folder = tmp_path_factory.mktemp("hidden")
    for name in ("scene.json", "truth.tum"):
        (folder / name).write_bytes((RIDE / name).read_bytes())
    source = source_from(RIDE, "standard")
    hide_anchors(folder / "log.csv", source.sample(np.random.default_rng(0)), false_paths=5)
    return folder


def options(folder, *more):
    truth = ("--truth", folder / "truth.tum", "--radio", "standard", "--speed", "auto")
    return ("localize", *localizing.options(folder / "log.csv", *truth, *more, folder=folder))


def test_the_command_reports_how_many_paths_were_associated(hidden, tmp_path):
    shown = succeed(*options(hidden, "--associate", "--json", tmp_path / "track.json"))
    figures = json.loads((tmp_path / "track.json").read_text())
    association = figures["association"]
    assert association["paths"] == 900 and association["without_track"] == {"epochs": 0, "paths": 0}
    assert association["false"] == 900 - sum(association["associated"].values())
    assert f"- 900 paths, {association['false']} of them false; the track was found once\n" in shown
    for name, paths in association["associated"].items():
        assert f"| {name} | {paths} | {association['missed'][name]} |\n" in shown
        assert paths + association["missed"][name] == 120
    with_labels = succeed(*options(RIDE, "--json", tmp_path / "labelled.json"))
    assert "paths" not in with_labels
    labelled = json.loads((tmp_path / "labelled.json").read_text())
    assert "association" not in labelled
    ates = [f["truth"]["tracks"]["filtered"]["ate_m"] for f in (figures, labelled)]
    assert ates[0] < 1.1 * ates[1]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "columns: found no anchor in time_s"),
        (("--associate", "--diagnose"), "diagnose: cannot be combined with --associate"),
    ],
)
def test_options_that_do_not_fit_the_log_are_refused(hidden, words, message):
    assert_one_clear_line(command(*options(hidden, *words)), message)
