"""Reader of text files in blocks of lines, so that even the longest file needs little memory."""

import gzip
import math
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mmwave_env.io.files import naming, open_regular

_BLOCK_BYTES = 1 << 20


class DamagedFileError(ValueError):
    """Error for a file that is damaged from some row on; all earlier rows are yielded first.

    Rows are counted from 1; ``unit`` is the word for a row in the message.
    """

    def __init__(
        self, path: Path, row: int, problem: str, expected: str, unit: str = "line"
    ) -> None:
        super().__init__(f"{path}, {unit} {row}: found {problem}, expected {expected}")
        self.row = row


def line_blocks(path: Path) -> Iterator[tuple[list[str], float]]:
    """Yield the lines of a text file, about 1 MiB at a time, and the share of the file read so far.

    A file whose name ends in ``.gz`` is unzipped. Lines are yielded without their line ends. Bytes
    that are not UTF-8 are escaped, so that messages can show them.

    Raises:
        OSError: the file can't be opened or read.
        DamagedFileError: the gzip data are broken, or a line is longer than 1 MiB.
    """
    with open_regular(path) as raw, naming(path):
        total = max(os.fstat(raw.fileno()).st_size, 1)
        zipped = path.suffix.lower() == ".gz"
        file: Any = gzip.GzipFile(fileobj=raw) if zipped else raw
        first = 1
        rest = b""
        end = False
        while not end:
            content, end, damage = _read(file)
            content = rest + content
            cut = len(content) if end and not damage else content.rfind(b"\n") + 1
            rest = content[cut:]
            content = content[:cut]
            text = content.decode("utf-8", errors="backslashreplace").replace("\r\n", "\n")
            lines = (text.removeprefix("\ufeff") if first == 1 else text).split("\n")
            if not lines[-1]:  # if the text ends with a line end, there is no line after it
                lines.pop()
            if lines:
                yield lines, min(raw.tell() / total, 1.0)
            first += len(lines)
            if damage:
                raise DamagedFileError(path, first, damage, "a complete file")
            if len(rest) > _BLOCK_BYTES:
                problem = f"more than {_BLOCK_BYTES} bytes that begin with {rest[:20]!r}"
                raise DamagedFileError(path, first, problem, "a line of text")


def _read(file: Any) -> tuple[bytes, bool, str]:
    """Return the next bytes, whether the file ends after them, and what is damaged, or ""."""
    pieces: list[bytes] = []
    size = 0
    while size < _BLOCK_BYTES:
        try:
            # If decompression fails, read() would lose the data before the failure.
            piece = file.read1(_BLOCK_BYTES)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            return b"".join(pieces), True, f"broken gzip data ({error})"
        if not piece:
            return b"".join(pieces), True, ""
        pieces.append(piece)
        size += len(piece)
    return b"".join(pieces), False, ""


def number(word: str) -> float:
    """Parse a number; return NaN for other words, and for 1_0 and ١, which numpy cannot read."""
    try:
        return float(word) if word.isascii() and "_" not in word else math.nan
    except ValueError:
        return math.nan
