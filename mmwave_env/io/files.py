"""Functions that read files up to a size limit and write files atomically; errors name the file."""

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from secrets import token_hex
from typing import Any, BinaryIO, TypeVar

T = TypeVar("T")
Json = dict[str, Any]  # an object of a JSON file
AnyPath = str | os.PathLike[str]

DATA = Path(__file__).parents[1] / "data"  # the folder of data in the package
TEXT_BYTES = 16 << 20  # maximum size of a text file; logs and trajectories may be longer
JSON_BYTES = 8 << 20  # maximum size of a JSON file; the largest in this project has 0.06 MB
# errors of code that converts unexpected content of a file
UNEXPECTED = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)


def _named(error: OSError, path: Path) -> OSError:
    """Return the same error, but with the name of a file."""
    return OSError(error.errno, error.strerror, str(path))  # Python picks the subclass by errno


@contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Add the name of a file to OS errors that name no file, such as the error of a full disk.

    Errors of the ``temporary`` file are also reported with the name of ``path``.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None or str(error.filename) not in ("None", str(temporary)):
            raise
        raise _named(error, path) from error


def first_line(error: Exception) -> str:
    """Return the first line of an error's message; for a KeyError, a line about the key."""
    if isinstance(error, KeyError):
        return f"{error.args[0]}: found none"
    return str(error).partition("\n")[0] or type(error).__name__


def open_regular(path: Path, expected: str = "a file") -> BinaryIO:
    """Open a file to read its bytes; refuse a FIFO or a device, which may block or never end.

    Raises:
        FileNotFoundError: there is no such file; ``expected`` describes it in the message.
        OSError: the path is not a regular file, or can't be opened.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected {expected}")
    if path.is_file():
        return path.open("rb")
    if path.exists():
        raise OSError(f"{path}: found a FIFO, a socket or a device, expected {expected}")
    raise FileNotFoundError(f"{path}: found no such file, expected {expected}")


def read_bounded(path: Path, most: int, expected: str = "a file") -> bytes:
    """Read all bytes of a file; refuse a file of more than ``most`` bytes.

    Raises:
        OSError: as for :func:`open_regular`, or the file has more than ``most`` bytes.
    """
    with open_regular(path, expected) as file, naming(path):
        content = file.read(most + 1)
        if len(content) > most:
            raise OSError(
                f"{path}: found a larger file, expected {expected} of at most {most} bytes"
            )
        return content


def read_text(path: Path, expected: str = "text", most: int = TEXT_BYTES) -> str:
    """Read a text file; line ends stay as they are, and a UTF-8 byte order mark is removed.

    Raises:
        ValueError: the text is not UTF-8; the message names file and line.
        OSError: as for :func:`read_bounded`.
    """
    content = read_bounded(path, most, expected)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        byte = content[error.start : error.start + 1]
        raise ValueError(
            f"{path}, line {line}: found {byte!r}, expected {expected} in UTF-8"
        ) from error


def parse_json(text: str) -> Any:
    """Parse JSON; refuse objects with a key twice, and lists or objects nested too deeply.

    Raises:
        ValueError: the text is not valid JSON; the message says what is wrong.
    """
    try:
        return json.loads(text, object_pairs_hook=_object)
    except RecursionError:
        raise ValueError(
            "found lists or objects nested too deeply, expected fewer levels"
        ) from None


def _object(pairs: list[tuple[str, Any]]) -> Json:
    content: Json = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"{key}: found this key twice, expected it once")
        content[key] = value
    return content


def read_json(path: Path, kind: str, make: Callable[[Json], T], see: str = "") -> T:
    """Read the object in a JSON file, pass it to ``make``, and return the result.

    Args:
        path: path of the file.
        kind: kind of the file, for messages, such as "a mode file".
        make: function that converts the object. If it fails because of a missing key or a value of
            a wrong type, its error is converted to the ValueError below.
        see: page or schema that describes this kind of file, for messages.

    Raises:
        ValueError: the file is invalid; the message names the file and what is wrong in it.
        OSError: as for :func:`read_bounded`; FileNotFoundError if there is no such file.
    """
    text = read_text(path, f"{kind}, JSON", JSON_BYTES)
    try:
        content = parse_json(text)
        if not isinstance(content, dict):
            raise ValueError(f"found {type(content).__name__}, expected an object")
        return make(content)
    except UNEXPECTED as error:
        described = f" ({see})" if see else ""
        raise ValueError(f"{path}: not {kind}: {first_line(error)}{described}") from error


def shipped_json(name: str) -> Json:
    """Return the object in a JSON file of the package's folder ``data``."""
    path = DATA / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def require_writable(path: Path) -> None:
    """Check before a long run that its result can be written; create missing folders."""
    target = _target_of(path)
    try:
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise _named(error, path) from error


def _target_of(path: Path) -> Path:
    """Return the file that a path or link points to; refuse a device; create missing folders."""
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(f"{path}: found a folder, expected a file to write")
    if path.exists() and not path.is_file():  # such as a pipe behind /dev/stdout
        raise OSError(f"{path}: found a device, expected a file to write")
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary file beside ``path``, with its suffixes, that replaces ``path`` at the end.

    If the block fails, the temporary file is removed and ``path`` stays as it was. Missing folders
    are created. A new file gets its permissions from the umask; a replaced file keeps its own.
    If ``path`` is a link, the file that it points to is replaced.

    Raises:
        OSError: the file can't be written; the message names ``path``.
    """
    target = _target_of(path)
    temporary = target.with_name(f".{token_hex(8)}.{target.name}")
    mode = target.stat().st_mode & 0o777 if target.exists() else None
    with naming(path, temporary):
        try:
            private = 0o666 if mode is None else 0o600  # permissions while writing
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, private))
            yield temporary
            if mode is not None:
                temporary.chmod(mode)
            temporary.replace(target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def write_text(path: Path, text: str) -> None:
    """Write a text file completely or not at all; create missing folders."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a binary file completely or not at all; create missing folders."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, content: Json) -> None:
    """Write a JSON file completely or not at all; create missing folders."""
    write_text(path, json.dumps(content, indent=2) + "\n")
