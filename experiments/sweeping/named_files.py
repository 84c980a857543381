"""What the files hold that a sweep names: with other content in them it is another sweep."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

_BLOCK = 1 << 20  # bytes read at once


def digests(values: Iterable[Any]) -> dict[str, str]:
    """A digest of every file, or folder of files, that a value or a part of one is the path of."""
    words = {word for value in values for word in _words(value)}
    return {word: _digest(Path(word)) for word in sorted(words) if os.path.exists(word)}


def _words(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, tuple):
        for one in value:
            yield from _words(one)


def _digest(path: Path) -> str:
    """Of names and content; of what is no regular file, which a cell will refuse, the name."""
    whole = hashlib.sha256()
    for one in sorted(path.rglob("*")) if path.is_dir() else [path]:
        whole.update(f"{one.relative_to(path)}\0".encode(errors="surrogateescape"))
        if one.is_file():
            with one.open("rb") as file:
                while block := file.read(_BLOCK):
                    whole.update(block)
    return whole.hexdigest()
