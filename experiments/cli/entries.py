"""Lists of names and what they mean."""

import textwrap
from collections.abc import Mapping


def entries(found: Mapping[str, str], column: int, width: int | None = None) -> list[str]:
    """Lines of names and what they mean.

    Args:
        found: meanings by name.
        column: where meanings begin.
        width: that lines are folded at, their rest below the meaning; None for whole lines.
    """
    lines = [f"  {name:{column - 3}} {what}" for name, what in found.items()]
    if width is None:
        return lines
    fold = textwrap.TextWrapper(
        width, subsequent_indent=" " * column, break_long_words=False, break_on_hyphens=False
    )
    return [folded for line in lines for folded in fold.wrap(line)]
