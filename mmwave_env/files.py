"""Files: what is read is bounded, what is written is whole or not there, and errors name both."""

import json
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from secrets import token_hex
from typing import Any, BinaryIO, TypeVar

T = TypeVar("T")

TEXT_BYTES = 16 << 20  # held at once at most; logs and tracks are streamed, and may be longer
JSON_BYTES = 8 << 20  # read as JSON at most: a hundred times what any of ours has
JSON_DEPTH = 50  # of lists and objects in each other

_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
}  # fmt: skip


# --- errors


def _named(error: OSError, path: Path) -> OSError:
    """The same error about a file."""
    return OSError(error.errno, error.strerror, str(path))  # of the subclass of its number


@contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """OS errors in the block that name no file, such as those of a full disk, name this one.

    Args:
        path: to name.
        temporary: a file whose errors are said of ``path``, too.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None or str(error.filename) not in ("None", str(temporary)):
            raise
        raise _named(error, path) from error


def told(error: Exception) -> str:
    """What an error says, in its first line; of a key that is not there, which."""
    if isinstance(error, KeyError):
        return f"{error.args[0]}: found none"
    return str(error).partition("\n")[0] or type(error).__name__


# --- reading


def open_regular(path: Path, expected: str = "a file") -> BinaryIO:
    """Open a file to read its bytes; not a FIFO, which would wait, nor a device without an end.

    Args:
        path: of the file.
        expected: for the message.

    Raises:
        FileNotFoundError: there is none.
        OSError: it is something else than a file, or can't be opened.
    """
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError, ValueError):  # the last: a name with a NUL
        raise FileNotFoundError(f"{path}: found no such file, expected {expected}") from None
    if kind != stat.S_IFREG:
        error = IsADirectoryError if kind == stat.S_IFDIR else OSError
        raise error(f"{path}: found {_KINDS.get(kind, 'no file')}, expected {expected}")
    return path.open("rb")


def read_bounded(path: Path, most: int, expected: str = "a file") -> bytes:
    """All bytes of a file, unless there are too many.

    Args:
        path: of the file.
        most: bytes that it may have.
        expected: for the message.

    Raises:
        OSError: as of :func:`open_regular`, or it is longer.
    """
    with open_regular(path, expected) as file, naming(path):
        size = os.fstat(file.fileno()).st_size
        content = file.read(most + 1) if size <= most else b""  # some systems' files tell no size
        if max(size, len(content)) > most:
            found = f"{size} bytes" if size > most else f"more than {most} bytes"
            raise OSError(f"{path}: found {found}, expected {expected} of at most {most}")
        return content


def read_text(path: Path, expected: str = "text", most: int = TEXT_BYTES) -> str:
    """All of a text file; line ends stay as they are, and a mark of UTF-8 goes.

    Raises:
        ValueError: naming the file and the line that is not UTF-8.
        OSError: as of :func:`read_bounded`.
    """
    content = read_bounded(path, most, expected)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        found, where = content[error.start : error.start + 1], f"{path}, line {line}"
        raise ValueError(f"{where}: found {found!r}, expected {expected} in UTF-8") from error


def parse_json(text: str) -> Any:
    """What JSON says; nesting that programs trip over is refused.

    Raises:
        ValueError: naming what is wrong.
    """
    nested = f"found lists or objects in each other, expected at most {JSON_DEPTH} deep"
    try:
        found = json.loads(text)
    except RecursionError:
        raise ValueError(nested) from None
    level = [found]
    for _ in range(JSON_DEPTH + 1):
        level = [*chain(*(one.values() if isinstance(one, dict) else one for one in level
                          if isinstance(one, dict | list)))]  # fmt: skip
    if level:
        raise ValueError(nested)
    return found


def read_json(path: Path, what: str, make: Callable[[dict[str, Any]], T], see: str = "") -> T:
    """What is made from the object in a JSON file.

    Args:
        path: of the file.
        what: it is, for messages, such as "a mode file".
        make: takes the object. What another shape of it makes code raise, of a key that is missing
            or a value of another type, becomes the ValueError here, too.
        see: where files of the kind are described, for messages.

    Raises:
        ValueError: naming the file and what is wrong in it.
        OSError: as of :func:`read_bounded`; FileNotFoundError where there is no such file.
    """
    text = read_text(path, f"{what}, JSON", JSON_BYTES)
    try:
        found = parse_json(text)
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected an object")
        return make(found)
    except (ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as error:
        raise ValueError(f"{path}: not {what}: {told(error)}{f' ({see})' * bool(see)}") from error


# --- writing


def require_writable(path: Path) -> None:
    """Find out before a long run whether its result can be written; makes folders on the way.

    Raises:
        OSError: it can't.
    """
    target = _target_of(path)
    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise _named(error, path) from error


def _target_of(path: Path) -> Path:
    """Where a result goes, behind links; folders on the way are made.

    Raises:
        OSError: something is there whose place a file must not take.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected a file to write")
    if path.exists() and not path.is_file():  # behind /dev/stdout may be a pipe without a place
        raise OSError(f"{path}: found a device, expected a file to write")
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A file to write, beside ``path`` and with its endings, that takes its place at the end.

    If the block fails, the file vanishes and ``path`` stays as it was. Folders on the way are
    made. Who may read a new file is as the umask says, and stays as it was where there was one;
    of a link, the file that it stands for is replaced.

    Raises:
        OSError: it can't be written; the message names ``path``.
    """
    target = _target_of(path)
    temporary = target.with_name(f".{token_hex(8)}.{target.name}")
    mode = target.stat().st_mode & 0o777 if target.exists() else None
    with naming(path, temporary):
        try:
            private = 0o666 if mode is None else 0o600  # until it is whole
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, private))
            yield temporary
            if mode is not None:
                temporary.chmod(mode)
            temporary.replace(target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


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
