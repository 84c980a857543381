"""Tables on a terminal."""

import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.cells import cell_len

from experiments.console.tables import grid, show

WORDS = st.from_regex(r"[a-z0-9.±-]{1,20}", fullmatch=True)


@pytest.fixture
def shown(monkeypatch, capsys):
    """Prints Markdown as on a terminal of a width."""
    monkeypatch.setenv("FORCE_COLOR", "1")

    def lines(text, width):
        monkeypatch.setenv("COLUMNS", str(width))
        capsys.readouterr()
        show(text)
        plain = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
        return [line.rstrip() for line in plain.splitlines()]

    return lines


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    names=st.lists(WORDS, max_size=5),
    cells=st.lists(WORDS, max_size=9),
    width=st.integers(44, 120),
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


def test_headers_are_folded_but_not_before_a_unit(shown):
    _, *header = shown(grid(["track", "NEES in 95 % bounds"], [["filtered", "0.9"]]), 60)
    words = [line.strip() for line in header if line][:4]
    assert words == ["track     NEES", "in", "95 %", "bounds"]


def test_a_name_wider_than_the_terminal_is_not_cut(shown):
    name = "runs/" + "long" * 20
    lines = shown(grid(["policy", "reward"], [[name, "-1.5"]]), 60)
    assert f"{name}  -1.5" in lines


def test_what_is_around_a_table_stays(shown):
    lines = shown(f"before\n\n{grid(['a', 'b'], [['1', '2']])}\n\n- after\n", 80)
    assert [line.strip(" •") for line in lines if line and "─" not in line] == [
        "before", "a  b", "1  2", "after",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["a|b", "\x1b[31mred", "one\ntwo", "漢字", r"a\|b\\", "$x$"])
def test_names_neither_break_a_table_nor_reach_the_terminal(shown, capsys, name):
    lines = shown(grid(["policy", "reward"], [[name, "-1.5"], ["imm", "-1.0"]]), 60)
    plain = name.encode("unicode_escape").decode() if not name.isprintable() else name
    rows = [line for line in lines if line.endswith(("-1.5", "-1.0"))]
    assert [row.rpartition("  ")[0].rstrip() for row in rows] == [plain, "imm"]
    assert len({cell_len(row) for row in rows}) == 1  # columns are aligned, wide letters or not


def test_what_is_no_table_is_shown_without_control_characters_too(monkeypatch, capsys):
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    show("### \x1b]0;title\x07 street\n\nnext\n")
    assert capsys.readouterr().out == "### \\x1b]0;title\\x07 street\n\nnext\n\n"


def test_no_color_is_shown_where_none_is_wanted(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    show(f"### title\n\n`code`\n\n{grid(['a'], [['1']])}\n")
    codes = re.findall(r"\x1b\[([0-9;]*)m", capsys.readouterr().out)
    assert not [code for code in codes if re.search(r"(^|;)(3|4|9|10)[0-9]", code)]
