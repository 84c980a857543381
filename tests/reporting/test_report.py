"""mmwave-loc report: what is on the page, and what is refused."""

import json

import numpy as np
import pytest

from experiments.evaluation.intervals import Interval, rounded
from experiments.figures.canvas import COLORS, NO_MODE
from experiments.reporting.webpage.played import play
from experiments.reporting.webpage.sources import read_source
from mmwave_env.io.lookup import printable
from mmwave_env.rendering.theme import THEMES, hex_of
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT
from tests.reporting import results
from tests.reporting.results import HOSTILE, Read, write

NONE = ("--episodes", 0)  # of them played again


@pytest.fixture(scope="module")
def track(tmp_path_factory):
    """Results of localize."""
    file = tmp_path_factory.mktemp("track") / "t.json"
    succeed("localize", "--sample", "canyon28_vehicle", "--imm", "imm", "--json", file)
    return json.loads(file.read_text())


def report(tmp_path, *words):
    """The page of results, taken apart."""
    out = tmp_path / "report.html"
    succeed("report", *words, "--out", out)
    return Read(out.read_text(encoding="utf-8"))


def compared(tmp_path, **more):
    """The page of a comparison, nothing played again."""
    return report(tmp_path, write(tmp_path / "r.json", results.comparison(**more)), *NONE)


# --- the first sentence


def test_it_begins_with_who_won_by_how_much_on_how_many_episodes(tmp_path):
    page = compared(tmp_path, names=("imm", "guided", "speed-rule"))
    assert page.title == "imm beats guided by 0.500 [0.400, 0.600] - mmwave-loc"
    said = page.text.split("Results")[0]
    assert "3 contenders on mixed, handset, 2 episodes, seeds 0 and up. imm won: its rew" in said
    assert "0.500 [0.400, 0.600] above that of guided, 95 % interval" in said


def test_it_does_not_say_more_than_results_do(tmp_path):
    for pairs, said in (
        ({"a - b": 0.05}, "No winner: the best reward, of a, minus that of b is 0.050"),
        ({"a - c": 0.5}, "Between them, but not paired with a here: b."),
        ({}, "a has a reward of -1.000 [-1.100, -0.900]"),
    ):
        paired = {name: results.metrics(mean) for name, mean in pairs.items()}
        assert said in compared(tmp_path, names=("a", "b", "c"), paired=paired).text


# --- sections


def test_tables_show_the_figures_of_the_file_best_first(tmp_path):
    content = results.comparison(("worse", "better"))
    rows = content["policies"]
    rows["worse"], rows["better"] = rows["better"], rows["worse"]
    page = report(tmp_path, write(tmp_path / "r.json", content), *NONE)
    header, *shown = page.table("Means")
    assert header[0] == "contender" and [row[0] for row in shown] == ["better", "worse"]
    for name, *cells in shown:
        assert cells == [rounded(Interval.of(one)) for one in rows[name].values()]
    assert page.table("Differences")[1] == [
        "better", "worse", "-0.500 [-0.600, -0.400]", "0.500 [0.400, 0.600]",
    ]  # fmt: skip
    assert "none were asked for" in page.text and "Errors" not in page.text


def test_tracks_and_runs_have_their_tables_and_a_sentence(tmp_path, track):
    broken = write(tmp_path / "t.json", track | {"error": "log.csv: line 41: found 'x'"})
    page = report(tmp_path, broken, results.run(tmp_path / "run", over=1))
    assert "not the whole log: log.csv: line 41: found 'x'" in page.text
    assert page.title.startswith(f"{track['epochs']} epochs of ")
    assert "1 of 2 trainings of" in page.text and "mmwave-loc train --resume goes on" in page.text
    _, row = page.table("on tuning seeds")
    assert row == ["0", "-1.5000", "2,000", "0.250 [0.150, 0.350]"]
    assert "Learning curves" in page.text and [tag for tag, _ in page.tags].count("figure") == 1


def test_several_comparisons_are_folded_but_for_the_first_and_say_how_they_were_made(tmp_path):
    parts = {"mixed": results.comparison(), "jam": results.comparison(scenario="jam")}
    page = report(tmp_path, write(tmp_path / "all.json", parts), *NONE)
    assert "mixed, handset, 2 episodes" in page.text and "jam, handset, 2 episodes" in page.text
    assert [known for tag, known in page.tags if tag == "details"] == [{"open": None}, {}]
    assert parts["mixed"]["command"] in page.text and "python 3.12.0" in page.text
    assert f"mmwave-loc report {tmp_path / 'all.json'} " in page.text


# --- what is played again


@pytest.mark.slow
def test_what_is_played_again_is_what_was_compared(tmp_path):
    """Means over the episodes played are those of the file, where it has no others."""
    file = tmp_path / "r.json"
    succeed("compare", "--policies", "imm", "guided", "speed-rule", "--episodes", 3,
            "--episode-steps", 40, "--seed", 7, "--percentiles", "--json", file)  # fmt: skip
    (source,) = read_source(file)
    found = play(source, 10, 2)
    for name, row in source.content["policies"].items():
        ate = np.linalg.norm(found.epochs.errors_m[name], axis=-1).mean()
        assert ate == pytest.approx(row["ate_m"]["mean"])
        assert found.epochs.nees[name].mean() == pytest.approx(row["nees"]["mean"])
    assert found.positions.figures() == source.content["position_errors"]
    assert [one["name"].split()[-1] for one in found.shown] == ["7", "8"]
    page = report(tmp_path, file, "--watch", 1)
    (episode,) = json.loads(page.data)["episodes"]
    assert set(episode["contenders"]) == set(source.content["policies"])
    for one in episode["contenders"].values():
        assert {len(letters) for letters in one["fate"]} == {len(episode["time_s"])} == {40}
        assert set("".join(one["fate"])) <= set("arm")
        away = np.hypot(*(np.subtract(one[axis], episode[axis]) for axis in "xy"))
        assert (away <= np.array(one["error_m"]) + 0.03).all()
    best, *others = map(page.table, ("Means", "Horizontal", "Vertical"))
    assert all([row[0] for row in rows] == [row[0] for row in best] for rows in others)
    assert "Distribution of errors (CDF)" in page.text and "NEES and its" in page.text


def test_a_track_can_be_watched_with_its_gates(tmp_path, track):
    page = report(tmp_path, write(tmp_path / "t.json", track))
    (episode,) = json.loads(page.data)["episodes"]
    (course,) = episode["contenders"].values()
    assert len(episode["time_s"]) == len(course["x"]) == track["epochs"]
    assert course["modes"] == list(track["modes"])
    for letters, group in zip(course["fate"], track["groups"].values(), strict=False):
        assert letters.count("r") == group["rejected"]
        assert letters.count("a") + letters.count("r") == group["seen"]
    assert course["error_m"][-1] is not None and course["nees"][-1] is not None
    # A mode has one color in the player, in films and in figures.
    film = [[hex_of(one) for one in THEMES[t].for_modes(["none", "ekf"]).modes] for t in THEMES]
    assert course["colors"][0] == f"light-dark({film[0][1]}, {film[1][1]})"
    assert film[0] == [NO_MODE, COLORS[0]]


def test_what_is_not_played_again_leaves_the_tables(tmp_path, track):
    content = {"gone": track | {"options": {"log": "gone.csv", "scene": "street"}}}
    for name, options in {"wrong": {"dt": "fast"}, "old": None, "unknown": {"new": 1}}.items():
        content[name] = results.comparison(("os:getcwd", "never:made"), options=options)
    files = [write(tmp_path / f"{name}.json", part) for name, part in content.items()]
    page = report(tmp_path, *files)
    for words in ("options: dt", "options: found", "gone.csv", "os:getcwd was", "never:made was"):
        assert words in page.text
    assert page.text.count("Means ±") == 3


# --- names, colors, files


def test_names_of_others_neither_break_the_page_nor_act_in_it(tmp_path, track):
    policies = {HOSTILE: results.metrics(-1.0), f"{HOSTILE}2": results.metrics(-2.0)}
    content = results.comparison(
        scenario=HOSTILE,
        policies=policies,
        paired={f"{HOSTILE} - {HOSTILE}2": results.metrics(1.0)},
    )
    log = write(tmp_path / "t.json", track | {"log": HOSTILE, "modes": {HOSTILE: 40}})
    run = results.run(tmp_path / "$<b>|日本")
    page = report(tmp_path, write(tmp_path / "r.json", content), log, run, *NONE)
    assert not [tag for tag, known in page.tags if tag in ("img", "b") or "onerror" in known]
    assert [tag for tag, _ in page.tags].count("script") == 2
    assert [row[0] for row in page.table("Means")[1:]] == [printable(one) for one in policies]
    assert "\x1b" not in page.text + page.data and "\u202e" not in page.text + page.data
    ids = [known["id"] for _, known in page.tags if "id" in known]
    assert len(ids) == len(set(ids))  # those inside of two pictures, too
    addresses = [known[key] for _, known in page.tags for key in ("src", "href") if key in known]
    assert {one for one in addresses if not one.startswith("#")} == {"data:,"}
    (policy,) = [known["content"] for _, known in page.tags if known.get("http-equiv")]
    assert policy.startswith("default-src 'none'")


def test_all_that_a_page_is_made_of_is_in_the_wheel():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for path in (ROOT / "experiments" / "reporting" / "webpage").iterdir():
        if path.is_file() and path.suffix != ".py":
            assert f'"reporting/webpage/*{path.suffix}"' in project


# --- what is refused


MISTAKES = {
    "no results": ({"a": 1}, "r.json: command: found none, expected results"),
    "no object": ([1], "r.json: not results: found list, expected an object"),
    "no interval": (results.comparison(policies={"imm": {"reward": 3}}), "r.json: .*expected res"),
    "no mean": (results.comparison(paired={"a": {"reward": {"ci95": None}}}), "mean: found none"),
    "a seed that is none": (results.comparison(seed=-1), "r.json: seed: found -1, expected 0 or"),
    "nobody": (results.comparison(policies={}), "r.json: .*expected results"),
    "a diagnosis": ({"command": "mmwave-loc localize", "verdict": ""}, "versions: found none"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_results_that_are_none_end_with_one_clear_line(tmp_path, mistake):
    content, message = MISTAKES[mistake]
    file = write(tmp_path / "r.json", content)
    done = command("report", file, "--out", tmp_path / "report.html")
    assert_one_clear_line(done, f"^mmwave-loc report: .*{message}")
    assert not (tmp_path / "report.html").exists()


def test_wrong_folders_and_options_end_with_one_clear_line(tmp_path):
    journal = results.run(tmp_path / "run") / "seed-0" / "progress.csv"
    journal.write_text("timesteps,tuning/minus a\n1,x\n")
    file = write(tmp_path / "r.json", results.comparison())
    for words, message in (
        ([tmp_path / "no"], "no: found no such file"),
        ([tmp_path], "found a folder, expected"),
        ([tmp_path / "run"], "progress.csv: line 2: could not convert .*'x'"),
        ([file, "--out", file], "out: found .*r.json, expected a name that ends with"),
        ([file, "--episodes", -1], "episodes: found -1, expected 0 or more"),
    ):
        assert_one_clear_line(command("report", *words), message)
