"""Writing results: beside, then renamed, so that a file is whole or not there."""

import json
import os
import tempfile
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
    with tempfile.TemporaryFile(dir=path.parent):
        pass


def write_text(path: Path, text: str) -> None:
    """Write a file in one step; folders on the way are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, beside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.chmod(beside, 0o644)
        os.replace(beside, path)
    except BaseException:
        os.unlink(beside)
        raise


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write JSON in one step."""
    write_text(path, json.dumps(content, indent=2) + "\n")
