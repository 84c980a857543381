"""Writing results: beside, then renamed, so that a file is whole or not there."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def require_writable(path: Path) -> None:
    """Find out before a long run whether its result can be written; makes folders on the way.

    Raises:
        OSError: it can't.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected a file to write")
    if path.exists() and not path.is_file():  # or the result would take the place of a device
        raise OSError(f"{path}: found a device, expected a file to write")
    with tempfile.TemporaryFile(dir=path.parent):
        pass


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A file to write, beside ``path`` and with its endings, that takes its place at the end.

    If the block fails, the file vanishes and ``path`` stays as it was. Folders on the way are
    made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=f".{path.name}")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A folder to fill, beside ``path``, that takes its place at the end, and that of an old one.

    If the block fails, the folder vanishes and ``path`` stays as it was. Folders on the way are
    made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as beside:
        new = Path(beside, path.name)
        new.mkdir()
        yield new
        if path.exists():
            path.replace(Path(beside, "replaced"))
        new.replace(path)


def write_text(path: Path, text: str) -> None:
    """Write a file in one step; folders on the way are made."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def write_bytes(path: Path, content: bytes) -> None:
    """Write a binary file in one step; folders on the way are made."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON in one step."""
    write_text(path, json.dumps(content, indent=2) + "\n")
