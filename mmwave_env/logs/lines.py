"""Reader of text files, which are read whole."""

import gzip
import math
import os
import zlib
from pathlib import Path
from typing import Any

from mmwave_env.io.files import naming, open_regular

_PIECE_BYTES = 1 << 20
_MEMORY = 20.0  # bytes of memory for each byte of text; the track of a log needs most of it


def read_lines(path: Path) -> tuple[list[str], str]:
    """Return the lines of a text file, and what is damaged after them; "" if nothing is.

    A file whose name ends in ``.gz`` is unzipped. Lines are returned without their line ends. Bytes
    that are not UTF-8 are escaped, so that messages can show them.

    Raises:
        OSError: the file can't be opened or read, or needs more memory than there is.
    """
    pieces = []
    done = 0
    damage = ""
    with open_regular(path) as raw, naming(path):
        size = os.fstat(raw.fileno()).st_size
        file: Any = gzip.GzipFile(fileobj=raw) if path.suffix.lower() == ".gz" else raw
        try:
            # If decompression fails, read() would lose the data before the failure.
            while piece := file.read1(_PIECE_BYTES):
                pieces.append(piece)
                done += len(piece)
                require_memory(path, _MEMORY * done * size / raw.tell())
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            damage = f"broken gzip data ({error})"
    text = b"".join(pieces).decode("utf-8-sig", errors="backslashreplace")
    lines = text.replace("\r\n", "\n").split("\n")
    if damage or not lines[-1]:  # damaged, or nothing after a line end
        lines.pop()
    return lines, damage


def free_memory() -> float:
    """Return how many bytes of memory this program can still use; infinity if this is unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return math.inf
    sizes = dict(line.split(":") for line in lines)
    return 1024.0 * float(sizes["MemAvailable"].split()[0])


def require_memory(path: Path, needed: float) -> None:
    """Refuse a file that needs more bytes of memory than are free."""
    free = free_memory()
    if needed > free:
        raise OSError(
            f"{path}: found a file that needs {needed / 1e9:.2g} GB of memory, expected at most "
            f"{free / 1e9:.2g} GB, which are free; divide the file"
        )


def number(word: str) -> float:
    """Parse a number; return NaN for other words, and for 1_0 and ١, which only Python can read."""
    try:
        return float(word) if word.isascii() and "_" not in word else math.nan
    except ValueError:
        return math.nan
