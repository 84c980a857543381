"""Options of mmwave-loc completion."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(kw_only=True)
class Args:
    """Let your shell complete commands and options of mmwave-loc with the Tab key.

    Writes the file that the shell reads when it starts. Needs the extra completion.

    mmwave-loc completion --shell bash
    """

    shell: Literal["bash", "zsh"] | None = None
    """for which shell (the one of $SHELL where none is named)"""
    out: Path | None = None
    """write it to this file instead"""
