"""Tests of ``mmwave-loc speed``, and of the function that renews the tables of a page in docs/."""

import re

import pytest

from experiments.console.doc_pages import MARK, renewed
from experiments.timing import latency
from experiments.timing.report import TITLES
from tests.cli import assert_one_clear_line, command, succeed
from tests.paths import ROOT, json_in

PAGE = ROOT / "docs" / "performance.md"


@pytest.mark.slow
def test_a_short_run_prints_and_writes_all_results(tmp_path, monkeypatch):
    monkeypatch.setattr(latency, "EPOCHS", 60)
    monkeypatch.setattr(latency, "WARM_UP", 10)
    page = tmp_path / "page.md"
    file = tmp_path / "new" / "all.json"
    page.write_text(PAGE.read_text())
    options = ("--sizes", 8, "--seconds", 0, "--repeats", 1)
    shown = succeed("speed", *options, "--json", file, "--docs", page)
    assert re.findall("^### (.*)", shown, re.MULTILINE) == list(TITLES)
    result = json_in(file)
    assert result["command"] == "mmwave-loc speed --sizes 8 --seconds 0.0 --repeats 1"
    assert {"ekf", "ukf", "ckf", "native_8_1_thread"} <= set(result["limit_fraction"])
    assert set(result["cold_start_s"]) == set(result["peak_rss_mb"])
    assert 20.0 < result["peak_rss_mb"]["single"] < 2000.0
    shown_now = {match[1]: match[0] for match in MARK.finditer(page.read_text())}
    assert all(table.split("\n", 1)[1].rpartition("\n")[0] in shown
               for table in shown_now.values())  # fmt: skip


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sizes", "8", "0"], r"sizes: found \[8, 0\], expected numbers of at least 1"),
        (["--seconds", "-1"], "seconds: found -1.0, expected a time of at least 0"),
        (["--repeats", "0"], "repeats: found 0, expected at least 1"),
        (["--docs", "CHANGELOG.md"], "CHANGELOG.md: found no table"),
        (["--docs", "docs/paper.md"], "found 'Table I', expected one of"),
    ],
)
def test_mistakes_end_with_one_clear_line_before_anything_is_timed(options, message):
    assert_one_clear_line(command("speed", *options), f"^mmwave-loc speed: .*{message}")


def test_a_page_is_renewed_only_between_its_marks():
    tables = {"T": "| a |\n|---|\n| 1 |\n\nnote"}
    page = "before\n<!-- table: T -->\nold\n<!-- end -->\nafter\n"
    expected = "before\n<!-- table: T -->\n| a |\n|---|\n| 1 |\n\nnote\n<!-- end -->\nafter\n"
    assert renewed(page, tables) == renewed(expected, tables) == expected
    # A table whose title begins with "printed" comes from an example in docs/ and is kept.
    printed = "<!-- table: printed | a -->\nby an example\n<!-- end -->\n"
    assert renewed(page + printed, tables) == expected + printed
