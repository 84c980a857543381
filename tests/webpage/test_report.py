"""mmwave-loc report: what is on the page, and what is refused."""

import json
import signal

import numpy as np
import pytest

from experiments.console.signals import Ended
from experiments.evaluation.intervals import Interval, rounded
from experiments.webpage import played
from experiments.webpage.page import in_script
from experiments.webpage.played import play
from experiments.webpage.sources import read_source
from mmwave_env import __version__
from mmwave_env.lookup import printable
from mmwave_env.metrics import BURN_IN
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT
from tests.webpage import results
from tests.webpage.reading import Read
from tests.webpage.results import HOSTILE, VERSIONS, write

NONE = ("--episodes", 0)  # of them played again


def report(tmp_path, *words):
    """The page of results, taken apart."""
    out = tmp_path / "report.html"
    succeed("report", *words, "--out", out)
    return Read(out.read_text(encoding="utf-8"))


def test_the_leaderboard_shows_the_figures_of_the_file_best_first(tmp_path):
    content = results.comparison(("worse", "better"))
    rows = content["policies"]
    rows["worse"], rows["better"] = rows["better"], rows["worse"]
    page = report(tmp_path, write(tmp_path / "r.json", content), *NONE)
    header, *shown = page.table("Means")
    assert header[0][0] == "policy" and [row[0][0] for row in shown] == ["better", "worse"]
    for (name, _), *cells in shown:
        for (text, value), figures in zip(cells, rows[name].values(), strict=True):
            assert float(value) == figures["mean"]
            assert text == rounded(Interval.of(figures))
    ((_, (minus, value)),) = [row for row in page.table("Paired")[1:] if row[1][0]]
    assert float(value) == -0.5 and minus == "-0.500 [-0.600, -0.400]"
    assert "none were asked for" in page.text


def test_a_signal_while_the_options_of_results_are_read_ends_it(tmp_path, monkeypatch):
    def end(*_):
        raise Ended(signal.SIGTERM)

    monkeypatch.setattr(played, "read_arguments", end)
    path, out = write(tmp_path / "r.json", results.comparison()), tmp_path / "page.html"
    done = command("report", path, "--out", out)
    assert (done.returncode, done.stdout) == (143, "") and not out.exists()


def test_transfer_track_and_run_have_their_tables(tmp_path):
    files = [write(tmp_path / f"{f.__name__}.json", f()) for f in (results.transfer, results.track)]
    page = report(tmp_path, *files, results.run(tmp_path / "run"))
    _, (place, reward, gain), _ = page.table("Reward where it was trained")
    assert (place[0], float(reward[1]), float(gain[1])) == ("street, handset", -1.25, 0.375)
    assert page.table("gates")[1][1:3] == [("40", "40"), ("2", "2")]
    assert [row[0][0] for row in page.table("on tuning seeds")[1:]] == ["0", "1 (median)"]
    (curves,) = json.loads(page.data)["charts"]
    assert [view["name"] for view in curves["views"]] == [
        "reward minus imm, tuning seeds", "reward, tuning seeds",
    ]  # fmt: skip
    assert [(line["x"], line["y"]) for line in curves["views"][1]["lines"]] == [
        ([2000.0], [-1.5])
    ] * 2


def test_runs_beside_each_other_are_a_table(tmp_path):
    for name in ("as-shipped", "larger"):
        results.run(tmp_path / "ablation" / name)
    rows = report(tmp_path, tmp_path / "ablation").table("beside each other")
    assert [row[0][0] for row in rows[1:]] == ["as-shipped", "larger"]
    assert [float(row[2][1]) for row in rows[1:]] == [-1.75, -1.75]  # the median of two: the worse


def test_an_interrupted_run_says_so_and_shows_what_is_there(tmp_path):
    page = report(tmp_path, results.run(tmp_path / "run", over=False))
    assert "interrupted, or still under way: 1 of 2 trainings begun are over" in page.text
    assert [row[0][0] for row in page.table("on tuning seeds")[1:]] == ["0"]
    assert len(json.loads(page.data)["charts"][0]["views"][0]["lines"]) == 2


def test_a_log_that_broke_off_says_so(tmp_path):
    file = write(tmp_path / "t.json", results.track(error="log.csv: line 41: found 'x'"))
    assert "Not the whole log: log.csv: line 41: found 'x'" in report(tmp_path, file).text


def test_the_page_says_how_it_was_made(tmp_path):
    content = results.comparison()
    file = write(tmp_path / "r.json", content)
    page = report(tmp_path, file, *NONE)
    assert content["command"] in page.text and f"mmwave-loc {__version__}" in page.text
    assert "Seeds 0 to 1" in page.text and f"mmwave-loc report {file} " in page.text


def test_names_of_others_neither_break_the_page_nor_act_in_it(tmp_path):
    policies = {HOSTILE: results.metrics(-1.0), f"{HOSTILE}2": results.metrics(-2.0)}
    content = results.comparison(scenario=HOSTILE, policies=policies, paired={
        f"{HOSTILE} - {HOSTILE}2": results.metrics(1.0),
    })  # fmt: skip
    files = [
        write(tmp_path / "r.json", content),
        write(tmp_path / "t.json", results.track(modes={HOSTILE: 40})),
        write(tmp_path / "x.json", results.transfer()),
        results.run(tmp_path / "$<b>|日本"),
    ]
    page = report(tmp_path, *files, *NONE)
    assert not [tag for tag, known in page.tags if tag == "img" or "onerror" in known]
    assert [tag for tag, _ in page.tags].count("script") == 2
    shown = [row[0][0] for row in page.table("Means")[1:]]
    assert shown == [printable(HOSTILE), printable(f"{HOSTILE}2")]
    (chart, *_) = json.loads(page.data)["charts"]
    assert chart["views"][0]["rows"][0][0] == printable(HOSTILE)
    assert "\x1b" not in page.text + page.data and "\u202e" not in page.text + page.data


def test_nothing_in_the_data_ends_their_script():
    names = ["</script>", "<!--<script>", "]]>", "&lt;", "\u2028", "\ud800"]
    written = in_script(names)
    assert written.isascii() and not set("<>&") & set(written) and json.loads(written) == names


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    page = report(tmp_path, write(tmp_path / "r.json", results.comparison()), *NONE)
    addresses = [known[key] for _, known in page.tags for key in ("src", "href") if key in known]
    assert addresses == ["data:,"]
    (policy,) = [known["content"] for tag, known in page.tags if known.get("http-equiv")]
    assert policy.startswith("default-src 'none'")


def test_every_row_of_a_table_has_as_many_cells_as_the_header(tmp_path):
    page = report(tmp_path, write(tmp_path / "r.json", results.comparison()), *NONE)
    for rows in page.tables.values():
        assert len({len(row) for row in rows}) == 1


def test_episodes_are_played_again(tmp_path):
    file = tmp_path / "r.json"
    succeed("compare", "--policies", "imm", "speed-rule", "--episodes", 2, "--episode-steps", 30,
            "--json", file)  # fmt: skip
    page = report(tmp_path, file, "--watch", 1)
    (episode,) = json.loads(page.data)["episodes"]
    assert episode["name"].endswith("seed 0") and len(episode["time_s"]) == 30
    assert set(episode["contenders"]) == {"imm", "speed-rule"}
    for course in episode["contenders"].values():
        assert {len(letters) for letters in course["fate"]} == {30}
        assert set("".join(course["fate"])) <= set("arm")
        assert len(course["nis"]) == len(episode["groups"]) == 4
        error = [
            ((x - a) ** 2 + (y - b) ** 2) ** 0.5
            for x, y, a, b in zip(course["x"], course["y"], episode["x"], episode["y"], strict=True)
        ]
        told = course["error_m"]
        assert all(flat <= whole + 0.03 for flat, whole in zip(error, told, strict=True))
    header, *rows = page.table("Errors that so many percent of the epochs stay below")
    assert len(rows) == 4 and len(header) == 12
    for (name, _), *cells in rows:
        assert name.split(", ")[1] in ("horizontal", "vertical")
        for part in (slice(0, 5), slice(5, 9)):  # percentiles, shares within a distance
            values = [float(value) for _, value in cells[part]]
            assert values == sorted(values) and values[-1] > 0.0
    (chart,) = [one for one in json.loads(page.data)["charts"] if one["kind"] == "stanford"]
    assert [view["name"] for view in chart["views"]] == [
        f"{kind}, {name}" for kind in ("horizontal", "vertical") for name in ("imm", "speed-rule")
    ]
    for view in chart["views"]:
        assert sum(count for *_, count in view["cells"]) == 2 * (30 - BURN_IN)
        assert max(place for *at, _ in view["cells"] for place in at) < view["side"]


def test_percentiles_of_a_whole_comparison_and_of_a_track_are_shown(tmp_path):
    files = [tmp_path / "r.json", tmp_path / "t.json"]
    succeed("compare", "--policies", "imm", "speed-rule", "--episodes", 2, "--episode-steps", 15,
            "--percentiles", "--risk", 0.05, "--json", files[0])  # fmt: skip
    succeed("localize", "--sample", "canyon28_vehicle", "--speed", 9, "--json", files[1])
    contents = [json.loads(file.read_text()) for file in files]
    whole = contents[0]["position_errors"]["policies"]
    tracks = contents[1]["truth"]["tracks"]
    page = report(tmp_path, *files, *NONE)
    for known, risk in ((whole, "0.05"), (tracks, "0.001")):
        _, *rows = page.table(f"which a risk of {risk} allows")
        expected = [
            [*one[kind]["percentiles_m"].values(), *one[kind]["within_m"].values(),
             one[kind]["median_level_m"], one[kind]["share"]]
            for one in known.values() for kind in ("horizontal", "vertical")
        ]  # fmt: skip
        assert [[float(value) for _, value in cells[1:]] for cells in rows] == expected


@pytest.mark.slow
def test_what_is_played_again_is_what_was_compared(tmp_path):
    """Means over the episodes played are those of the file, where it has no others."""
    file = tmp_path / "r.json"
    succeed("compare", "--policies", "imm", "guided", "speed-rule", "--episodes", 3,
            "--episode-steps", 40, "--seed", 7, "--json", file)  # fmt: skip
    (source,) = read_source(file)
    played = play(source, 10, 2)
    for name, row in source.content["policies"].items():
        ate = np.linalg.norm(played.errors_m[name], axis=-1).mean()
        assert ate == pytest.approx(row["ate_m"]["mean"])
        assert played.nees[name].mean() == pytest.approx(row["nees"]["mean"])
    assert [one["name"].split()[-1] for one in played.shown] == ["7", "8"]


def test_code_of_others_is_not_run_for_a_page(tmp_path):
    file = write(tmp_path / "r.json", results.comparison(("speed-rule", "os:getcwd", "never.zip")))
    page = report(tmp_path, file)
    for name in ("os:getcwd", "never.zip"):
        assert f"{name} was not played again: it is code of its own" in page.text
    rows = page.table("Errors that so many percent of the epochs stay below")[1:]
    assert [row[0][0] for row in rows] == ["speed-rule, horizontal", "speed-rule, vertical"]


def test_a_command_that_is_not_understood_leaves_the_tables(tmp_path):
    content = results.comparison(command="mmwave-loc compare --no-such-option")
    page = report(tmp_path, write(tmp_path / "r.json", content))
    assert "What is behind it was not played again" in page.text and page.table("Means")
    assert "no-such-option" in page.text


def without(key):
    content = results.comparison()
    del content[key]
    return content


OLD = {"versions": VERSIONS | {"mmwave-loc": "9.9"}}
MISTAKES = {
    "an unknown key": (
        results.comparison(surprise=1, **OLD), "r.json: surprise: found a key written by "
        f"mmwave-loc 9.9 that mmwave-loc {__version__} does not know.*expected command",
    ),
    "no policies": (without("policies"), f"r.json: policies: found none.*{__version__}"),
    "an unknown command": (
        results.comparison(command="mmwave-loc fly", **OLD),
        "r.json: command: found the command 'fly', written by mmwave-loc 9.9; .*reads results of",
    ),
    "no results": ({"a": 1}, "r.json: command: found no command.*an unknown version"),
    "no object": ([1], "r.json: not results: found list, expected an object"),
    "no interval": (
        results.comparison(policies={"imm": {"reward": 3}}),
        "r.json: policies.imm.reward: found 3, expected a mean",
    ),
    "no mean": (
        results.comparison(paired={"a - b": {"reward": {"ci95": None}}}), "paired.a - b.reward",
    ),
    "a seed that is none": (results.comparison(seed=-1), "r.json: seed: found -1, expected 0 or"),
    "no number of meters": (
        results.comparison(position_errors={"risk": 1e-3, "policies": {
            "imm": {"horizontal": results.errors(median_level_m="far")},
        }}), "position_errors.imm.horizontal: found 'far', expected a number",
    ),
    "no share": (
        results.comparison(position_errors={"risk": 1e-3, "policies": {
            "imm": {"vertical": {"percentiles_m": {}, "within_m": {}, "ci95": None}},
        }}), "median_level_m: found none, written by",
    ),
    "a table of nothing": (results.comparison(policies=[]), "r.json: policies: found list"),
    "no groups": (results.track(groups={"a": {}}), "r.json: seen: found none, written by"),
    "a diagnosis": (
        {**results.track(), "verdict": "fine", "hypotheses": []}, "verdict: found a diagnosis",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_results_that_are_none_end_with_one_clear_line(tmp_path, mistake):
    content, message = MISTAKES[mistake]
    file = write(tmp_path / "r.json", content)
    done = command("report", file, "--out", tmp_path / "report.html")
    assert_one_clear_line(done, f"^mmwave-loc report: .*{message}")
    assert not (tmp_path / "report.html").exists()


def broken_journal(folder):
    (results.run(folder) / "seed-0" / "progress.csv").write_text("timesteps,tuning/a\n1,x\n")


def unknown_key_of_a_run(folder):
    write(results.run(folder) / "summary.json", {"command": "", "hyperparameters": {}, "new": 1})


FOLDERS = {
    "no file": (lambda folder: None, "run: found no file, expected results"),
    "an empty folder": (lambda folder: folder.mkdir(), "run: found neither run.json nor results"),
    "a broken journal": (broken_journal, "progress.csv: line 2: tuning/a: found 'x'"),
    "an unknown key": (unknown_key_of_a_run, "summary.json: new: found a key.*unknown version"),
    "not JSON": (
        lambda folder: folder.write_text("{"),
        "run: not results: Expecting property name",
    ),
}


@pytest.mark.parametrize("mistake", FOLDERS)
def test_folders_that_are_no_runs_end_with_one_clear_line(tmp_path, mistake):
    make, message = FOLDERS[mistake]
    make(tmp_path / "run")
    done = command("report", tmp_path / "run", "--out", tmp_path / "report.html")
    assert_one_clear_line(done, message)


def test_wrong_options_end_with_one_clear_line(tmp_path):
    file = write(tmp_path / "r.json", results.comparison())
    for words, message in (
        (("--out", tmp_path / "r.json"), "out: found .*r.json, expected a name that ends with"),
        (("--episodes", -1), "episodes: found -1, expected 0 or more"),
    ):
        assert_one_clear_line(command("report", file, *words), message)
    assert_one_clear_line(command("report"), "required: RESULTS|required: results")


def test_several_comparisons_in_one_file_are_read(tmp_path):
    parts = {"mixed": results.comparison(), "jam": results.comparison(scenario="jam")}
    page = report(tmp_path, write(tmp_path / "all.json", parts), *NONE)
    assert "mixed, handset, 2 episodes" in page.text and "jam, handset, 2 episodes" in page.text


def test_a_track_can_be_watched_with_its_gates(tmp_path):
    file = tmp_path / "t.json"
    succeed("localize", "--sample", "canyon28_vehicle", "--imm", "imm", "--json", file)
    content = json.loads(file.read_text())
    page = report(tmp_path, file)
    (episode,) = json.loads(page.data)["episodes"]
    (course,) = episode["contenders"].values()
    epochs = min(600, content["epochs"])
    assert len(episode["time_s"]) == len(course["x"]) == epochs
    assert course["modes"] == list(content["modes"])
    if epochs == content["epochs"]:
        for letters, group in zip(course["fate"], content["groups"].values(), strict=False):
            assert letters.count("r") == group["rejected"]
            assert letters.count("a") + letters.count("r") == group["seen"]
    assert course["error_m"][-1] is not None and course["nees"][-1] is not None


def test_a_log_that_is_gone_leaves_its_tables(tmp_path):
    page = report(tmp_path, write(tmp_path / "t.json", results.track()))
    assert "was not played again: its speed was typed" in page.text and page.table("gates")
    gone = results.track(command="mmwave-loc localize gone.csv --scene street --speed auto")
    page = report(tmp_path, write(tmp_path / "t.json", gone))
    assert "gone.csv" in page.text and "was not played again: " in page.text and page.table("gates")


def test_a_page_that_is_too_large_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.webpage.page.LARGEST_BYTES", 1000)
    file = write(tmp_path / "r.json", results.comparison())
    done = command("report", file, *NONE, "--out", tmp_path / "report.html")
    assert_one_clear_line(done, "results: found enough for a page of .* MB, expected at most")
    assert not (tmp_path / "report.html").exists()


def test_all_that_a_page_is_made_of_is_in_the_wheel():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    for path in (ROOT / "experiments" / "webpage").iterdir():
        if path.is_file() and path.suffix != ".py":
            assert f'"webpage/*{path.suffix}"' in project
