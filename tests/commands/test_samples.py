"""mmwave-loc samples, and localize --sample: what comes with the package is found."""

import json
import re
from itertools import product

import pytest

from mmwave_env.episodes.samples import sample_names
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import LOGS, RECORDINGS, ROOT, numbers


def test_every_sample_is_listed_and_where_it_is():
    told = succeed("samples")
    rows = [line.strip("| ").split(" | ") for line in told.splitlines() if line.startswith("| can")]
    assert [row[:3] for row in rows] == [
        ["canyon28_pedestrian", "log", "400"],
        ["canyon28_vehicle", "log", "120"],
        ["canyon28_pedestrian", "recording", "400"],
        ["canyon28_stop_and_go", "recording", "587"],
        ["canyon28_vehicle", "recording", "120"],
        ["canyon28_walk_ride_walk", "recording", "908"],
    ]
    assert {row[3] for row in rows} == {"0.1"}
    assert [row[4] for row in rows] == ["39.9", "11.9", "39.9", "58.6", "11.9", "90.7"]
    assert str(LOGS) in told and str(RECORDINGS) in told


@pytest.mark.parametrize(("kind", "where"), [("log", LOGS), ("recording", RECORDINGS)])
def test_a_sample_is_copied_byte_by_byte(tmp_path, kind, where):
    out, name = tmp_path / "new" / "copy", sample_names()[0]
    told = succeed("samples", "--copy", name, "--kind", kind, "--out", out)
    files = {path.name: path.read_bytes() for path in out.iterdir()}
    assert files == {path.name: path.read_bytes() for path in (where / name).iterdir()}
    assert told == f"copied to {out}/: {len(files)} files\n"


def test_a_copy_overwrites_nothing(tmp_path):
    (tmp_path / "truth.tum").write_text("mine")
    done = command("samples", "--copy", "canyon28_vehicle", "--out", tmp_path)
    assert_one_clear_line(done, "truth.tum: found a file, expected a folder without it")
    assert [path.name for path in tmp_path.iterdir()] == ["truth.tum"]
    assert (tmp_path / "truth.tum").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--copy", "canyon"], "copy: found alone, expected --copy NAME --out FOLDER"),
        (["--out", "there"], "out: found alone, expected --copy NAME --out FOLDER"),
        (["--copy", "canyon", "--out", "there"], "sample: found 'canyon', expected one of can"),
    ],
)  # fmt: skip
def test_mistakes_end_with_one_clear_line(tmp_path, words, message):
    assert_one_clear_line(command("samples", *words, cwd=tmp_path), message)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow  # compiles the policies for each
def test_policies_meet_on_every_recording_as_compare_runs_them(tmp_path):
    policies = ("fixed-ekf", "fixed-ukf")
    told = succeed("samples", "--policies", *policies, "--episodes", 2)
    rows = [line.strip("| ").split(" | ") for line in told.splitlines() if line.startswith("| can")]
    assert [tuple(row[:2]) for row in rows] == list(product(sample_names(), policies))
    for name in sample_names():
        alone = succeed("compare", "--data", name, "--policies", *policies, "--episodes", 2)
        for policy in policies:
            (row,) = (row for row in rows if row[:2] == [name, policy])
            assert f"| {' | '.join(row[1:4])} |" in alone


def test_data_md_has_the_table_of_every_recording():
    page = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    part = page.split("<!-- samples:")[1].split("<!-- end of samples")[0]
    shown = re.findall(r"^\| (canyon\w+) \| ([\w-]+) \|", part, re.MULTILINE)
    (line,) = re.findall(r"^mmwave-loc samples --policies (.*)$", page, re.MULTILINE)
    assert shown == list(product(sample_names(), line.split()))


@pytest.mark.slow
def test_the_table_in_data_md_is_what_the_command_prints():
    page = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    part = page.split("<!-- samples:")[1].split("-->\n", 1)[1].split("<!-- end of samples")[0]
    (line,) = re.findall(r"^mmwave-loc (samples --policies .*)$", page, re.MULTILINE)
    made = succeed(*line.split())
    assert numbers(made) == pytest.approx(numbers(part), abs=0.002)


# --- localize --sample


def test_a_sample_is_localized_with_its_scene_and_truth(tmp_path):
    folder, shared = LOGS / "canyon28_vehicle", ["--radio", "standard", "--speed", "auto"]
    given = [folder / "log.csv", "--scene", folder / "scene.json", "--truth", folder / "truth.tum"]
    named = ["--sample", "canyon28_vehicle"]
    figures = []
    for words in (given, named):
        succeed("localize", *words, *shared, "--json", tmp_path / "figures.json")
        figures.append(json.loads((tmp_path / "figures.json").read_text()))
        assert figures[-1].pop("command").startswith("mmwave-loc localize")  # says how it was asked
    assert figures[0] == figures[1] and figures[0]["truth"]["scored"] == 120


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "log: found none, expected a measurement log, or --sample NAME"),
        (["a.csv"], "scene: found none, expected --scene with that of a.csv"),
        (["a.csv", "--sample", "canyon28_vehicle"], "log: found a.csv, but --sample brings it"),
        (["--scene", "o1", "--sample", "canyon28_vehicle"], "scene: found o1, but --sample"),
        (["--sample", "canyon"], "sample: found 'canyon', expected one of canyon28_pedestrian"),
    ],
)
def test_what_localize_is_not_given_is_named(words, message):
    assert_one_clear_line(command("localize", *words, "--speed", "1"), message)
