"""Tables on a terminal."""

import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from experiments.evaluation.markdown import grid, show

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


def test_a_name_wider_than_the_terminal_is_not_cut(shown):
    name = "runs/" + "long" * 20
    lines = shown(grid(["policy", "reward"], [[name, "-1.5"]]), 60)
    assert f"{name}  -1.5" in lines


def test_what_is_around_a_table_stays(shown):
    lines = shown(f"before\n\n{grid(['a', 'b'], [['1', '2']])}\n\n- after\n", 80)
    assert [line.strip(" •") for line in lines if line and "─" not in line] == [
        "before", "a  b", "1  2", "after",
    ]  # fmt: skip
