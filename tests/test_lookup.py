"""Names of others: what they may be, and how they are shown."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mmwave_env.lookup import LONGEST, as_cell, as_name, did_you_mean, is_name, printable, quoted

TEXT = st.text(st.characters(codec=None), max_size=200)


@given(TEXT)
def test_what_is_shown_holds_no_control_characters(text):
    assert printable(text).isprintable()
    assert printable(text) == text or not text.isprintable()


def test_escape_sequences_line_ends_and_broken_letters_are_spelled_out():
    assert printable("a\x1b[31m\n\u202eb\udcff") == r"a\x1b[31m\n\u202eb\udcff"
    assert printable("прогулка 漢字 é") == "прогулка 漢字 é"


def test_names_are_short_and_have_letters_only():
    for name in ("a", "a b|c $x$ <b>", "прогулка 漢字", "x" * LONGEST):
        assert is_name(name)
    for name in ("", "a\nb", "\x1b[31m", "\udcff", "\u202e", "x" * (LONGEST + 1), 7, None, ["a"]):
        assert not is_name(name)


@given(TEXT)
def test_whatever_a_file_is_called_becomes_a_name(text):
    assert is_name(as_name(text))
    assert as_name(text) == text or not is_name(text)


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1"])
def test_a_formula_is_text_in_a_table(name):
    assert as_cell(name) == f"'{name}" and as_cell(f"a{name}") == f"a{name}"


def test_long_values_are_cut_in_messages():
    assert quoted("a") == "'a'" and quoted(1.5) == "1.5"
    assert quoted("x" * 10**6).startswith("'xxx") and len(quoted("x" * 10**6)) == LONGEST
    assert did_you_mean("x" * 10**6, ["x" * 9]) == ""
