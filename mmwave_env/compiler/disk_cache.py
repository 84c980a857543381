"""A disk cache that keeps compiled functions for later processes and is never out of date.

numba's ``cache=True`` checks only the file of the function itself. If another file, whose code the
function calls, is edited, numba returns stale code. Some versions of numba also miss an edit
that leaves the file's time and size unchanged. Processes that start at the same time can mix up
numba's files, and a damaged file or a full disk ends the program. This cache names its folder after
a hash of all sources, and writes each compiled function to one file. After an error with a file, it
compiles the function again. A checksum detects damage before the file's content is run. If a source
is edited while a process runs, the process stops using the cache: it may have read either version.

The files are pickles, like numba's own, and reading a pickle runs code that its author chose. So
folders and files are private to this user: the cache rejects links and anything that another user
owns or may write to. It then tries the next folder of a list. The parent folder may be shared, like
``/tmp``: a folder that another user created there fails the check of the owner.
"""

import os
import pickle
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from glob import glob
from hashlib import sha256
from os.path import getmtime
from pathlib import Path
from typing import Any, BinaryIO

import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from platformdirs import user_cache_path

Function = Callable[..., Any]
_PACKAGE = Path(__file__).parents[1]  # an edit anywhere in the package makes a new version
_READ = time.time()  # if a source is edited later, this process may have read either version
_KEPT = 8  # number of versions of the sources whose compiled functions are kept
_CHECKSUM = sha256().digest_size  # length, in bytes, of the checksum with which a file begins


def compiled(function: Function) -> Any:
    """Compile a module-level function with numba, so that it runs without the interpreter's lock.

    For a function that only compiled code calls, ``register_jitable`` is enough.
    """
    return _with_cache(numba.njit(nogil=True, error_model="numpy")(function), function)


def compiled_callback(signature: Any, function: Function) -> Any:
    """Compile a function as ``numba.cfunc`` does, with the disk cache.

    Compiled code may differ between processes without a change in the sources, for example if it
    calls a user's function. Then callers must give ``function`` another qualified name for each,
    because files and symbols are named after it.
    """
    arguments, returned = normalize_signature(signature)
    callback = _with_cache(CFunc(function, (arguments, returned), {}, {}), function)
    callback.compile()
    return callback


def _with_cache(compiler: Any, function: Function) -> Any:
    if folder := _folder():
        with suppress(OSError):  # the function may not come from a file
            compiler._cache = _OnDisk(function, folder)
    return compiler


@cache  # so the process keeps its folder, even if a source is edited while it runs
def _folder() -> Path | None:
    """Return the folder for code compiled from the current sources; None if no folder can be used.

    Its parent is numba's ``NUMBA_CACHE_DIR`` (if set), the user's folder for caches or the
    package's ``__pycache__``: the first of the three that can hold a private, writable folder.
    Files in the package's folder would survive ``pip uninstall``, and the package would then still
    be found.
    """
    version = _version()
    if version is None:
        return None
    parents = [user_cache_path("mmwave-env", appauthor=False), _PACKAGE / "__pycache__"]
    if numba.config.CACHE_DIR:
        parents.insert(0, Path(numba.config.CACHE_DIR).absolute())
    for parent in parents:
        folder = parent / f"{_PACKAGE.name}-{version}"
        with suppress(OSError):
            if not parent.is_absolute():  # the user has no home folder
                continue
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _is_ours(os.lstat(folder), stat.S_IFDIR):
                continue
            os.utime(folder)  # marks an existing folder as in use, which mkdir does not
            tempfile.TemporaryFile(dir=folder).close()
            _prune(parent)
            return folder
    return None


def _prune(parent: Path) -> None:
    """Remove this user's cache folders in ``parent``, except the most recently used ones."""
    with suppress(OSError):  # another process may be removing them, too
        versions = parent.glob(f"{_PACKAGE.name}-*")
        ours = [path for path in versions if _is_ours(os.lstat(path), stat.S_IFDIR)]
        for old in sorted(ours, key=getmtime)[:-_KEPT]:
            shutil.rmtree(old, ignore_errors=True)


def _sources() -> list[str]:
    """Return the names of all source files of the package."""
    # Unlike rglob, glob passes over folders that another process has just removed.
    return sorted(glob("**/*.py", root_dir=_PACKAGE, recursive=True))


def _version() -> str | None:
    """Return a hash of everything that affects compiled code; None if the sources are not files."""
    sources = _sources()
    if not sources:
        return None
    whole = sha256(f"{sys.version} {numba.__version__} {np.__version__}".encode())
    for name in sources:
        whole.update(name.encode())
        whole.update(sha256((_PACKAGE / name).read_bytes()).digest())
    return whole.hexdigest()[:20]


def _edited() -> bool:
    """Return whether a source has changed since this process began to read the sources."""
    with suppress(OSError):
        files = (os.stat(_PACKAGE / name) for name in _sources())
        return any(max(file.st_mtime, file.st_ctime) > _READ for file in files)
    return True


def _opened(file: Path) -> BinaryIO:
    """Open a file if only this user can have written to it and its folder; else raise OSError.

    The open file is checked, not its name, which may refer to another file a moment later.
    """
    if not hasattr(os, "geteuid"):  # Windows: it has no user ids and cannot open folders
        return file.open("rb")
    folder = _descriptor(file.parent, stat.S_IFDIR)
    try:
        return open(file.name, "rb", opener=lambda name, _: _descriptor(name, stat.S_IFREG, folder))
    finally:
        os.close(folder)


def _descriptor(path: str | Path, kind: int, folder: int | None = None) -> int:
    """Open a path, or a name in an open folder, for reading; fail unless it passes _is_ours."""
    # With these flags, open neither follows a link nor waits for the writer of a pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    if _is_ours(os.fstat(descriptor), kind):
        return descriptor
    os.close(descriptor)
    raise PermissionError(f"{path} may have been written by another user")


def _is_ours(status: os.stat_result, kind: int) -> bool:
    """Return whether a file is of this kind, this user owns it and nobody else may write to it."""
    if stat.S_IFMT(status.st_mode) != kind:
        return False
    if not hasattr(os, "geteuid"):  # Windows itself protects a user's folders from others
        return True
    return status.st_uid == os.geteuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _checksum(key: str, content: bytes) -> bytes:
    """Return a checksum of key and content, so that a file for another key is refused."""
    return sha256(key.encode() + content).digest()


class _OnDisk(NullCache):  # type: ignore[misc]
    """The cache that numba reads before it compiles a function and writes to afterwards."""

    def __init__(self, function: Function, folder: Path) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"
        # The folder's name does not depend on sources outside the package, such as a policy's.
        self._source = sha256(Path(function.__code__.co_filename).read_bytes()).hexdigest()
        self._folder = folder

    def load_overload(self, signature: Any, context: Any) -> Any:
        context.refresh()
        if _edited():
            return None
        key, file = self._entry(signature, context.codegen())
        with suppress(Exception), _opened(file) as entry:  # the file may be missing or unsafe
            checksum = entry.read(_CHECKSUM)
            content = entry.read()
            if checksum == _checksum(key, content):
                return CompileResult._rebuild(context, *pickle.loads(content))
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        # Code with dynamic globals contains addresses that are valid only in this process.
        if result.library.has_dynamic_globals or _edited():
            return
        key, file = self._entry(signature, result.codegen)
        with suppress(OSError), tempfile.TemporaryDirectory(dir=self._folder) as atomic_path:
            whole = Path(atomic_path, file.name)
            whole.touch(mode=0o600)
            content = dumps(result._reduce())
            whole.write_bytes(_checksum(key, content) + content)
            whole.replace(file)

    def _entry(self, signature: Any, codegen: Any) -> tuple[str, Path]:
        """Return the key (text that identifies this version of the function) and the file."""
        key = f"{self._name} {self._source} {signature} {codegen.magic_tuple()}"
        return key, self._folder / f"{self._name}-{sha256(key.encode()).hexdigest()[:20]}"
