"""What the files hold that a sweep names: with other content in them it is another sweep."""

import hashlib
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from mmwave_env.files import TEXT_BYTES, read_bounded

_DEPTH = 2  # folders within a folder, as runs and recordings have; "/" by a slip has very many


def digests(values: Iterable[Any]) -> dict[str, str]:
    """A digest of every file, or folder of files, that a value or a part of one is the path of."""
    words = {word for value in values for word in _words(value)}
    paths = {word: Path(word) for word in sorted(words) if os.path.exists(word)}
    return {
        word: "".join(_stamps(path, _DEPTH)) if path.is_dir() else _digest(path)
        for word, path in paths.items()
    }


def _words(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, tuple):
        for one in value:
            yield from _words(one)


def _digest(path: Path) -> str:
    """Of a small file the content; of another, or what is none, when it was last changed."""
    try:
        return hashlib.sha256(read_bounded(path, TEXT_BYTES)).hexdigest()
    except (OSError, ValueError):
        return _stamp(path)


def _stamp(path: Path) -> str:
    found = path.lstat()
    return f"{path.name} {found.st_size} {found.st_mtime_ns};"


def _stamps(folder: Path, depth: int) -> Iterator[str]:
    """How the files in a folder were last changed; nothing of what vanishes or is not shown."""
    with suppress(OSError):
        for path in sorted(folder.iterdir()):
            if not path.is_dir():
                with suppress(OSError):
                    yield _stamp(path)
            elif depth:
                yield f"{path.name}/"
                yield from _stamps(path, depth - 1)
