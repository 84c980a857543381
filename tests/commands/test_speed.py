"""Tests of ``mmwave-loc speed``."""

import re

import pytest

from experiments.timing import measured
from tests.cli import assert_one_clear_line, command, succeed
from tests.pages import blocks_of, made
from tests.paths import ROOT, json_in

PAGE = ROOT / "docs" / "performance.md"


@pytest.mark.slow
def test_a_short_run_prints_and_writes_all_results(tmp_path, monkeypatch):
    monkeypatch.setattr(measured, "EPOCHS", 60)
    monkeypatch.setattr(measured, "WARM_UP", 10)
    file = tmp_path / "new" / "all.json"
    options = ("--sizes", 8, "--seconds", 0, "--repeats", 1)
    shown = succeed("speed", *options, "--json", file)
    titles = re.findall("^### (.*)", shown, re.MULTILINE)
    assert titles == ["Ratios", "Steps per second", "Limit of the core", "Latency"]
    result = json_in(file)
    assert result["command"] == "mmwave-loc speed --sizes 8 --seconds 0.0 --repeats 1"
    assert {"EKF", "UKF", "CKF", "native, N = 8, 1 thread"} <= set(result["limit_fraction"])
    for block in blocks_of(PAGE):
        for table in block.tables:
            assert made(table, shown, tmp_path).splitlines()[:2] == table["shown"].splitlines()[:2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sizes", "8", "0"], r"sizes: found \[8, 0\], expected numbers of at least 1"),
        (["--seconds", "-1"], "seconds: found -1.0, expected a time of at least 0"),
        (["--repeats", "0"], "repeats: found 0, expected at least 1"),
    ],
)
def test_mistakes_end_with_one_clear_line_before_anything_is_timed(options, message):
    assert_one_clear_line(command("speed", *options), f"^mmwave-loc speed: .*{message}")
