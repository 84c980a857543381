"""Pages in docs/ whose tables are written by commands, never by hand."""

import re
from collections.abc import Mapping
from pathlib import Path

from mmwave_env.io.files import require_writable

# MARK skips tables titled "printed ...": tests/pages.py renews them from the output of examples.
MARK = re.compile(r"<!-- table: (?!printed)(.*?) -->\n.*?<!-- end -->", re.DOTALL)


def page_to_renew(path: Path) -> str:
    """Read a page whose tables are to be replaced.

    Raises:
        ValueError: the page has no lines that mark a table.
        OSError: the page can't be read or written.
    """
    require_writable(path)
    page = path.read_text(encoding="utf-8")
    if not MARK.search(page):
        raise ValueError(f"{path}: found no table, expected <!-- table: ... --> and <!-- end -->")
    return page


def renewed(page: str, tables: Mapping[str, str]) -> str:
    """Return a page in which the new ``tables`` replace the marked tables of the same titles.

    Raises:
        ValueError: the page has a table whose title is not in ``tables``.
    """

    def table(match: re.Match[str]) -> str:
        title = match[1]
        if title not in tables:
            raise ValueError(f"table of the page: found {title!r}, expected one of {list(tables)}")
        return f"<!-- table: {title} -->\n{tables[title]}\n<!-- end -->"

    return MARK.sub(table, page)
