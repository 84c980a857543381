"""What others named reaches nobody unescaped, and comes back as it was."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.markdown import Markdown

from experiments.console.tables import grid
from experiments.console.text import (
    escaped,
    printable_lines,
    unescaped,
)
from mmwave_env.lookup import printable

NAMES = st.text(st.characters(codec=None), max_size=30)


def test_the_ends_of_lines_stay_where_lines_are_shown():
    assert printable_lines("a\nb\r\x07") == "a\nb\\r\\x07"


@given(NAMES)
def test_plain_text_comes_back_from_markdown(name):
    assert unescaped(escaped(name)) == printable(name)


@pytest.mark.parametrize(
    "name",
    ["a|b", "$x$ and $y$", "<script>alert(1)</script>", "*bold*", "__init__", r"back\slash",
     "`code`", "[link](http://example.org)", "&lt;", "~~gone~~"],
)  # fmt: skip
def test_markdown_shows_a_name_letter_by_letter(name):
    console = Console(width=200, no_color=True)
    with console.capture() as shown:
        console.print(Markdown(escaped(name)))
    assert shown.get().strip() == name
    assert not re.search(r"(?<!\\)<[a-z/]", escaped(name))


def test_what_the_project_writes_itself_needs_no_escapes():
    for text in ("0.635 [0.516, 0.763]", "fixed-ekf", "ekf_robust", "RMSE < ATE", "1.2 ± 0.1"):
        assert escaped(text) == text


@given(st.lists(NAMES, min_size=1, max_size=4))
def test_a_table_has_a_line_a_row_whatever_its_names_are(names):
    lines = grid(["name", "reward"], [[name, "1"] for name in names]).split("\n")
    assert len(lines) == 2 + len(names) and all(line.isprintable() for line in lines)
    assert all(len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) == 3 for line in lines)
