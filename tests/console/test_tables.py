"""Tests that text from users is escaped where it is shown, and that tables fit on terminals."""

import io
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from experiments.console import output as terminal
from experiments.console.output import (
    escaped,
    grid,
    progress,
    show,
    tracked,
    unescaped,
)
from mmwave_env.io.lookup import LONGEST, as_cell, as_name, did_you_mean, is_name, printable, quoted

NAMES = st.text(st.characters(codec=None), max_size=200)


@given(NAMES)
def test_printable_text_has_no_control_characters(text):
    assert printable(text).isprintable()
    assert printable(text) == text or not text.isprintable()


def test_names_are_short_and_printable():
    for name in ("a", "a b|c $x$ <b>", "прогулка 漢字", "x" * LONGEST):
        assert is_name(name)
    for name in ("", "a\nb", "\x1b[31m", "\udcff", "\u202e", "x" * (LONGEST + 1), 7, None, ["a"]):
        assert not is_name(name)


@given(NAMES)
def test_any_file_name_can_be_made_a_valid_name(text):
    assert is_name(as_name(text))
    assert as_name(text) == text or not is_name(text)


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"])
def test_a_formula_becomes_text_in_a_cell(name):
    assert as_cell(name) == f"'{name}" and as_cell(f"a{name}") == f"a{name}"


def test_long_values_are_cut_in_messages():
    assert quoted("a") == "'a'" and quoted(1.5) == "1.5"
    assert quoted("x" * 10**6).startswith("'xxx") and len(quoted("x" * 10**6)) == LONGEST
    assert did_you_mean("x" * 10**6, ["x" * 9]) == ""


@given(NAMES)
def test_unescaping_markdown_gives_the_printable_text(name):
    assert unescaped(escaped(name)) == printable(name)


@given(st.lists(NAMES, min_size=1, max_size=4))
def test_a_table_has_one_line_per_row_for_any_names(names):
    lines = grid(["name", "reward"], [[name, "1"] for name in names]).split("\n")
    assert len(lines) == 2 + len(names) and all(line.isprintable() for line in lines)
    assert all(len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) == 3 for line in lines)


# --- printed lines and progress bars

AWKWARD = "$x$|a\nb\x1b[31m[red]\u202e<script>"
# AWKWARD as it is printed
SPELLED = r"$x$|a\nb\x1b[31m[red]\u202e<script>"


def test_bars_show_names_literally(monkeypatch):
    screen = io.StringIO()  # instead of a terminal of 100 columns

    def console(**_):
        return Console(file=screen, force_terminal=True, width=100, color_system=None)

    monkeypatch.setattr(terminal, "Console", console)
    with progress(AWKWARD) as report:
        report(0.5)
    assert list(tracked([1, 2], AWKWARD)) == [1, 2]
    assert SPELLED in screen.getvalue()
    assert "\x1b[31m" not in screen.getvalue() and "\u202e" not in screen.getvalue()


# --- tables

WORDS = st.from_regex(r"[a-z0-9.±-]{1,20}", fullmatch=True)


@pytest.fixture
def shown(monkeypatch, capsys):
    """Return a function that shows Markdown on a terminal and returns the lines shown."""
    monkeypatch.setenv("FORCE_COLOR", "1")

    def lines(text, width):
        monkeypatch.setenv("COLUMNS", str(width))
        capsys.readouterr()
        show(text)
        plain = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
        return [line.rstrip() for line in plain.splitlines()]

    return lines


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    names=st.lists(WORDS, max_size=5), cells=st.lists(WORDS, max_size=9), width=st.integers(44, 120)
)
def test_no_cell_of_a_table_is_cut_and_no_line_is_too_long(shown, names, cells, width):
    header = ["policy", *(f"column {i}" for i in range(len(cells)))]
    lines = shown(grid(header, [[name, *cells] for name in names]), width)
    assert max(map(len, lines)) <= width
    rules = [i for i, line in enumerate(lines) if line.startswith("──")]
    tables = [lines[i + 1 : i + 1 + len(names)] for i in rules]
    for table in tables:
        assert [line.split()[0] for line in table] == names
    for i in range(len(names)):
        assert [cell for table in tables for cell in table[i].split()[1:]] == cells


def test_a_name_wider_than_the_terminal_is_not_cut(shown):
    name = "runs/" + "long" * 20
    lines = shown(grid(["policy", "reward"], [[name, "-1.5"]]), 60)
    assert f"{name}  -1.5" in lines


def test_text_around_a_table_is_kept(shown):
    lines = shown(f"before\n\n{grid(['a', 'b'], [['1', '2']])}\n\n- after\n", 80)
    kept = [line.strip(" •") for line in lines if line and "─" not in line]
    assert kept == ["before", "a  b", "1  2", "after"]


SPECIAL = ["a|b", "\x1b[31mred", "one\ntwo", "漢字", r"a\|b\\", "$x$", "<script>", "*bold*", "&lt;"]
SPECIAL += ["__init__", "`code`", "~~gone~~"]


@pytest.mark.parametrize("name", SPECIAL)
def test_names_with_special_characters_are_escaped_in_tables(shown, name):
    lines = shown(grid(["policy", "reward"], [[name, "-1.5"], ["imm", "-1.0"]]), 60)
    plain = name.encode("unicode_escape").decode() if not name.isprintable() else name
    rows = [line for line in lines if line.endswith(("-1.5", "-1.0"))]
    assert [row.rpartition("  ")[0].rstrip() for row in rows] == [plain, "imm"]
    assert not re.search(r"(?<!\\)<[a-z/]", escaped(name))
    assert len({cell_len(row) for row in rows}) == 1  # columns stay aligned


def test_text_outside_tables_is_shown_without_control_characters(monkeypatch, capsys):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    show("### \x1b]0;title\x07 street\n\nnext\n")
    assert capsys.readouterr().out == "### \\x1b]0;title\\x07 street\n\nnext\n\n"
