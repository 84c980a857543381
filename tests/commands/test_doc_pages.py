"""Pages with tables that commands renew."""

import pytest

from experiments.console.doc_pages import page_to_renew, renewed


def test_a_page_is_renewed_between_its_marks_alone():
    tables = {"T": "| a |\n|---|\n| 1 |\n\nnote"}
    page = "before\n<!-- table: T -->\nold\n<!-- end -->\nafter\n"
    expected = "before\n<!-- table: T -->\n| a |\n|---|\n| 1 |\n\nnote\n<!-- end -->\nafter\n"
    assert renewed(page, tables) == renewed(expected, tables) == expected


def test_a_mark_without_a_table_is_named():
    with pytest.raises(ValueError, match=r"found 'U', expected one of \['T'\]"):
        renewed("<!-- table: U -->\n<!-- end -->", {"T": ""})


def test_a_page_without_marks_is_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("no table\n")
    with pytest.raises(ValueError, match="page.md: found no table"):
        page_to_renew(page)
