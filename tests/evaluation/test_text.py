"""What others named reaches nobody unescaped, and comes back as it was."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.markdown import Markdown

from experiments.evaluation.markdown import grid
from experiments.evaluation.text import (
    entries,
    escaped,
    printable,
    printable_lines,
    unescaped,
)

NAMES = st.text(st.characters(codec=None), max_size=30)


@given(NAMES)
def test_what_is_shown_holds_no_control_characters(name):
    assert printable(name).isprintable()
    assert printable(name) == name or not name.isprintable()


def test_escape_sequences_line_ends_and_broken_letters_are_spelled_out():
    assert printable("a\x1b[31m\n\u202eb\udcff") == r"a\x1b[31m\n\u202eb\udcff"
    assert printable("прогулка 漢字 é") == "прогулка 漢字 é"
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


@pytest.mark.parametrize("width", [40, 60, 80])
def test_entries_are_folded_between_words_and_below_their_meaning(width):
    found = {"ekf": "short", "imm-best": "tuned IMM over modes that stand, cruise" * 3}
    whole = entries(found, 20)
    assert [line.split(maxsplit=1) for line in whole] == [[n, w.strip()] for n, w in found.items()]
    lines = entries(found, 20, width)
    assert max(map(len, lines)) <= width and " ".join(lines).split() == " ".join(whole).split()
    assert all(line[:20].strip() in ("ekf", "imm-best", "") for line in lines)
