"""Tests of the page that ``mmwave-loc report`` writes, and of results that the command refuses."""

import json
import re
import sys

import numpy as np
import pytest

from experiments.evaluation.intervals import Interval, rounded
from experiments.reporting.webpage import page as webpage
from mmwave_env.io.lookup import printable
from mmwave_env.metrics import scored
from tests.cli import assert_refused, succeed, with_json
from tests.paths import ROOT, write_json
from tests.reporting import results
from tests.reporting.results import HOSTILE, Read

NONE = ("--episodes", 0)  # options that replay no episodes


@pytest.fixture(scope="module")
def track():
    """Return the results of `localize` for a track."""
    return with_json("localize", "--sample", "canyon28_vehicle", "--imm", "imm")[1]


def report(tmp_path, *words):
    """Return the parsed page that the command makes from results."""
    out = tmp_path / "report.html"
    succeed("report", *words, "--out", out)
    return Read(out.read_text(encoding="utf-8"))


def compared(tmp_path, content):
    """Return the parsed page of a comparison, without replayed episodes."""
    return report(tmp_path, write_json(tmp_path / "r.json", content), *NONE)


def names_in(page, label):
    """Return the first column of the table with this label, without its header."""
    return [row[0] for row in page.table(f'aria-label="{label}"')[1:]]


@pytest.mark.parametrize(
    ("pairs", "title"),
    [
        ({"a - b": 0.5}, "a beats b by 0.500 [0.400, 0.600]"),
        ({"a - b": 0.05}, "a and b are level"),
        ({"a - b": 0.1004}, "a and b are level"),
        ({"a - c": 0.5}, "a beats c by 0.500 [0.400, 0.600]"),
        ({}, "a has a reward of -1.000 [-1.100, -0.900]"),
    ],
)
def test_the_title_states_the_main_result(tmp_path, pairs, title):
    paired = {name: results.metrics(mean) for name, mean in pairs.items()}
    page = compared(tmp_path, results.comparison(("a", "b", "c"), paired=paired))
    assert page.title == f"{title} - mmwave-loc"


def test_tables_show_the_numbers_of_the_file_and_the_best_policy_first(tmp_path):
    content = results.comparison(("worse", "better"))
    rows = content["policies"]
    rows["worse"], rows["better"] = rows["better"], rows["worse"]
    files = [
        write_json(tmp_path / "a.json", content),
        write_json(tmp_path / "b.json", results.comparison()),
    ]
    page = report(tmp_path, *files, *NONE)
    assert [known for tag, known in page.tags if tag == "details"] == [{"open": None}, {}]
    assert content["command"] in page.text and "python 3.12.0" in page.text
    _, *shown = page.table('aria-label="policy"')
    assert [row[0] for row in shown] == ["better", "worse"]
    for name, *cells in shown:
        assert cells == [rounded(Interval.of(cell)) for cell in rows[name].values()]
    pair = ["better", "-0.500 [-0.600, -0.400]"]
    assert page.table('aria-label="reward of"')[1] == pair


def test_a_page_of_a_track_has_tables_and_a_title(tmp_path, track):
    broken = write_json(tmp_path / "t.json", track | {"error": "log.csv: line 41: found 'x'"})
    page = report(tmp_path, broken)
    assert "log.csv: line 41: found 'x'" in page.text
    assert page.title.startswith(f"{track['epochs']} epochs of ")
    assert names_in(page, "measured") == [*track["groups"]]


@pytest.mark.slow
def test_the_report_plays_the_compared_episodes_again(tmp_path):
    """Check that replayed episodes have the means of the file, as far as the page rounds values."""
    file = tmp_path / "r.json"
    options = "--policies imm guided speed-rule --episodes 3 --episode-steps 40 --seed 7"
    succeed("compare", *options.split(), "--percentiles", "--json", file)
    part = webpage.read_part(file)
    webpage.play(part, 10)
    for name, row in part.content["policies"].items():
        courses = [episode["contenders"][name] for episode in part.episodes]
        for column, metric in (("error_m", "ate_m"), ("nees", "nees")):
            values = np.array([course[column] for course in courses])
            mean = values[:, scored(40)].mean()
            assert mean == pytest.approx(row[metric]["mean"], rel=2e-3, abs=5e-3)
    assert [episode["name"].split()[-1] for episode in part.episodes] == ["7", "8", "9"]
    page = report(tmp_path, file, "--episodes", 1)
    (episode,) = json.loads(page.data)["episodes"]
    assert set(episode["contenders"]) == set(part.content["policies"])
    for course in episode["contenders"].values():
        assert {len(letters) for letters in course["fate"]} == {len(episode["time_s"])} == {40}
        away = np.hypot(*(np.subtract(course[axis], episode[axis]) for axis in "xy"))
        assert (away <= np.array(course["error_m"]) + 0.03).all()
    best = names_in(page, "policy")
    rows = re.findall(r">([^<>]+), (horizontal|vertical)</th>", page.page)
    assert rows == [(name, kind) for name in best for kind in ("horizontal", "vertical")]


def test_a_track_can_be_played_with_its_gate_decisions(tmp_path, track):
    page = report(tmp_path, write_json(tmp_path / "t.json", track))
    (episode,) = json.loads(page.data)["episodes"]
    (course,) = episode["contenders"].values()
    assert len(episode["time_s"]) == len(course["x"]) == track["epochs"]
    assert course["modes"] == list(track["modes"])
    for letters, group in zip(course["fate"], track["groups"].values(), strict=False):
        assert letters.count("r") == group["rejected"]
        assert letters.count("a") + letters.count("r") == group["seen"]
    assert course["error_m"][-1] is not None and course["nees"][-1] is not None


def test_tables_are_shown_even_if_episodes_cannot_be_played_again(tmp_path, track):
    content = {"gone": track | {"command": "mmwave-loc localize gone.csv --scene street"}}
    script = tmp_path / "script"
    ends = f"compare --tyro-write-completion bash {script}"
    for name in ("compare", "compare --dt fast", "speed --sizes 8", "compare --help", ends):
        command = f"mmwave-loc {name}"
        content[name] = results.comparison(("os:getcwd", "never:made"), command=command)
    files = [
        write_json(tmp_path / f"{number}.json", part)
        for number, part in enumerate(content.values())
    ]
    page = report(tmp_path, *files)
    refused = ("--dt", "--sizes", "found --help", "found --tyro-write-completion")
    for words in (*refused, "gone.csv", "os:getcwd was", "never:made was"):
        assert words in page.text
    assert page.text.count("Means ±") == 5 and not script.exists()


def test_modules_that_results_name_are_not_imported(tmp_path, monkeypatch, track):
    (tmp_path / "trap.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    words = "localize --sample canyon28_vehicle --policy trap:make"
    names = ("trap:make", "fixed-ekf")
    made = "compare --policies trap:make fixed-ekf --episodes 2 --episode-steps 30"
    contents = {
        "t.json": track | {"command": f"mmwave-loc {words}"},
        "r.json": results.comparison(names, command=f"mmwave-loc {made}"),
    }
    page = report(tmp_path, *(write_json(tmp_path / n, c) for n, c in contents.items()))
    assert "no episode was played again: a user's code" in page.text
    assert "trap:make was not played again: a user's code" in page.text
    assert "trap" not in sys.modules
    for episode in json.loads(page.data)["episodes"]:
        assert set(episode["contenders"]) == {"fixed-ekf"}
    assert names_in(page, "measured") == [*track["groups"]]


def test_hostile_names_neither_break_the_page_nor_run_code_in_it(tmp_path, track):
    policies = {HOSTILE: results.metrics(-1.0), f"{HOSTILE}2": results.metrics(-2.0)}
    content = results.comparison(
        scenario=HOSTILE,
        policies=policies,
        paired={f"{HOSTILE} - {HOSTILE}2": results.metrics(1.0)},
    )
    log = write_json(tmp_path / "t.json", track | {"log": HOSTILE, "modes": {HOSTILE: 40}})
    page = report(tmp_path, write_json(tmp_path / "r.json", content), log, *NONE)
    assert not [tag for tag, known in page.tags if tag == "b" or "onerror" in known]
    assert [tag for tag, _ in page.tags].count("script") == 2
    assert names_in(page, "policy") == [*map(printable, policies)]
    assert not {"\x1b", "\u202e"} & {*page.text, *page.data}
    ids = page.attributes("id")
    assert len(ids) == len(set(ids))
    assert all(url.startswith(("#", "data:")) for url in page.attributes("src", "href"))
    (policy,) = (known["content"] for _, known in page.tags if known.get("http-equiv"))
    assert policy.startswith("default-src 'none'")


def test_the_wheel_has_all_files_that_make_up_a_page():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for path in (ROOT / "experiments" / "reporting" / "webpage").iterdir():
        if path.is_file() and path.suffix != ".py":
            assert f'"reporting/webpage/*{path.suffix}"' in project


MISTAKES = {  # name -> content of a results file, expected message
    "no interval": (results.comparison(policies={"imm": {"reward": 3}}), ""),
    "no mean": (results.comparison(paired={"a": {"reward": {"ci95": None}}}), "mean: found"),
    "a wrong seed": (results.comparison(seed=-1), "seed: found -1"),
    "no policies": (results.comparison(policies={}), ""),
    "a diagnosis": ({"command": "mmwave-loc localize", "verdict": ""}, "policies: found none"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_files_that_are_not_results_are_refused_in_one_clear_line(tmp_path, mistake):
    content, message = MISTAKES[mistake]
    assert_refused(
        f"r.json: .*{message}",
        "report",
        write_json(tmp_path / "r.json", content),
        "--out",
        tmp_path / "page.html",
    )
    assert not (tmp_path / "page.html").exists()


def test_wrong_folders_and_options_are_refused_in_one_clear_line(tmp_path):
    file = write_json(tmp_path / "r.json", results.comparison())
    mistakes = {
        "no: found": [tmp_path / "no"],
        "found a folder": [tmp_path],
        "out: found .*r.json": [file, "--out", file],
        "episodes: found -1": [file, "--episodes", -1],
    }
    for message, words in mistakes.items():
        assert_refused(message, "report", *words)
