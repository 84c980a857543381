"""Compiled functions, kept on disk for the next process and never out of date.

A process that steps one environment a few hundred times would spend most of its time compiling, so
small amounts of work run as plain Python (:class:`LazyJit`).

numba's ``cache=True`` looks at the file of the function alone, so it answers with old code once
a function it calls was edited in another file; some versions miss edits that keep time and
size, too. Processes that start at once can mix up its files, and a damaged file or a full disk
ends the program. Here a folder is named after all sources, each compiled function is one file
in it, and whatever goes wrong with a file means that the function is compiled anew. A checksum
tells a damaged file before anything in it is run. A process whose sources are edited while it runs
neither reads nor writes files: nobody knows which of them it runs.

The files are pickles, as numba's own are, and whoever writes a pickle runs code where it is read.
So folders and files are made for us alone, and nothing is read that another user owns, that others
may write to or that is a link; instead of such a folder the next place is taken. The place a folder
lies in may be shared, as ``/tmp`` is: of what others put there in its stead we are not the owner.
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
from hashlib import sha256
from os.path import getmtime
from pathlib import Path
from typing import Any, BinaryIO

import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.registry import cpu_target
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.misc.appdirs import user_cache_dir

_PACKAGE = Path(__file__).parents[1]  # with all rooms: whatever is edited makes a new version
_READ = time.time()  # what was edited later, this process may have read before or after
_KEPT = 8  # versions of the sources whose compiled functions stay
_CHECKSUM = sha256().digest_size  # bytes at the beginning of each file


def compiled(function: Callable[..., Any]) -> Any:
    """A function of a module, compiled by numba to run without the interpreter's lock.

    For what Python calls; functions that only compiled ones call need ``register_jitable`` alone.
    """
    return _with_cache(numba.njit(nogil=True)(function), function)


def compiled_callback(signature: Any, function: Callable[..., Any]) -> Any:
    """A function as ``numba.cfunc`` makes it, compiled here.

    What differs from process to process without a change in our sources, such as what a user's
    function computes, must be told by its qualified name: so files and symbols are told apart.
    """
    arguments, returned = normalize_signature(signature)
    callback = _with_cache(CFunc(function, (arguments, returned), {}, {}), function)
    callback.compile()
    return callback


def _with_cache(compiler: Any, function: Callable[..., Any]) -> Any:
    if folder := _folder():
        compiler._cache = _Kept(function, folder)
    return compiler


def is_compiled(function: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether a :func:`compiled` function is there for such arguments, in memory or on disk."""
    signature, cache = tuple(map(numba.typeof, arguments)), function._cache
    return signature in function.overloads or (isinstance(cache, _Kept) and cache.has(signature))


@cache  # of the sources as they were when this process read them
def _folder() -> Path | None:
    """Where this version's functions are kept; None where nothing can be written.

    In numba's own ``NUMBA_CACHE_DIR`` if it is set; beside Python's bytecode, if the package
    is writable; else in the user's folder for caches.
    """
    version = _version()
    if version is None:
        return None
    for place in _places():
        folder = place / f"{_PACKAGE.name}-{version}"
        with suppress(OSError):
            if not place.is_absolute():  # nobody's home
                continue
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not _is_ours(os.lstat(folder), stat.S_IFDIR):
                continue
            os.utime(folder)  # in use now, which mkdir does not note where it is there
            tempfile.TemporaryFile(dir=folder).close()
            _prune(place)
            return folder
    return None


def _places() -> list[Path]:
    """Where folders may lie, the first choice first."""
    places = [_PACKAGE / "__pycache__", Path(user_cache_dir("mmwave-env", appauthor=False))]
    return [*([Path(numba.config.CACHE_DIR).absolute()] * bool(numba.config.CACHE_DIR)), *places]


def kept_functions() -> dict[str, Any]:
    """Where this process keeps compiled functions; makes the folder if it can.

    Returns:
        "place", None where no folder can be written that is ours alone; how many "functions" of
        this version of the sources lie there, and their "bytes".
    """
    folder = _folder()
    sizes = [file.stat().st_size for file in folder.iterdir()] if folder else []
    place = folder and str(folder)
    return {"place": place, "functions": len(sizes), "bytes": sum(sizes)}


def _prune(place: Path) -> None:
    """Remove versions long out of use, if they are ours."""
    with suppress(OSError):  # another process removes them, too
        versions = place.glob(f"{_PACKAGE.name}-*")
        ours = [path for path in versions if _is_ours(os.lstat(path), stat.S_IFDIR)]
        for old in sorted(ours, key=getmtime)[:-_KEPT]:
            shutil.rmtree(old, ignore_errors=True)


def _version() -> str | None:
    """A name for all that compiled code is made from; None where the sources are no files."""
    sources = sorted(_PACKAGE.rglob("*.py"))
    if not sources:
        return None
    whole = sha256(f"{sys.version} {numba.__version__} {np.__version__}".encode())
    for path in sources:
        whole.update(str(path.relative_to(_PACKAGE)).encode())
        whole.update(sha256(path.read_bytes()).digest())
    return whole.hexdigest()[:20]


def _edited() -> bool:
    """Whether a source changed since this process read the first of them."""
    with suppress(OSError):
        found = map(os.stat, _PACKAGE.rglob("*.py"))
        return any(max(file.st_mtime, file.st_ctime) > _READ for file in found)
    return True


def _opened(file: Path) -> BinaryIO:
    """A file that only we can have written, in such a folder; OSError for any other.

    Checked is what is open, as a name may mean something else a moment later.
    """
    if not hasattr(os, "geteuid"):  # nor can Windows open folders
        return file.open("rb")
    folder = _descriptor(file.parent, stat.S_IFDIR)
    try:
        return open(file.name, "rb", opener=lambda name, _: _descriptor(name, stat.S_IFREG, folder))
    finally:
        os.close(folder)


def _descriptor(path: str | Path, kind: int, folder: int | None = None) -> int:
    """What lies at a path, or under a name in a folder, open for reading if it is ours."""
    # Neither following a link nor waiting for the writer of a pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=folder)
    if _is_ours(os.fstat(descriptor), kind):
        return descriptor
    os.close(descriptor)
    raise PermissionError(f"{path} may be others' work")


def _is_ours(found: os.stat_result, kind: int) -> bool:
    """Whether it is of that kind, we own it and nobody else may write to it."""
    if stat.S_IFMT(found.st_mode) != kind:
        return False
    if not hasattr(os, "geteuid"):  # Windows, which closes a user's folders to others itself
        return True
    return found.st_uid == os.geteuid() and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _checksum(key: str, content: bytes) -> bytes:
    """Of what is kept and what it is kept for, so that neither passes for another."""
    return sha256(key.encode() + content).digest()


class _Kept(NullCache):  # type: ignore[misc]
    """What numba asks before it compiles a function, and tells when it has."""

    def __init__(self, function: Callable[..., Any], folder: Path) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._folder = folder

    @property
    def cache_path(self) -> str:
        return str(self._folder)

    def has(self, signature: Any) -> bool:
        """Whether a version of the function is there, if nothing is wrong with its file."""
        with suppress(OSError):
            _opened(self._entry(signature, cpu_target.target_context.codegen())[1]).close()
            return True
        return False

    def load_overload(self, signature: Any, context: Any) -> Any:
        context.refresh()
        if _edited():
            return None
        key, file = self._entry(signature, context.codegen())
        with suppress(Exception), _opened(file) as entry:  # none there, or none to rely on
            checksum, content = entry.read(_CHECKSUM), entry.read()
            if checksum == _checksum(key, content):
                return CompileResult._rebuild(context, *pickle.loads(content))
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        if result.library.has_dynamic_globals or _edited():  # the first: addresses of this process
            return
        key, file = self._entry(signature, result.codegen)
        with suppress(OSError), tempfile.TemporaryDirectory(dir=self._folder) as atomic_path:
            whole = Path(atomic_path, file.name)
            whole.touch(mode=0o600)
            content = dumps(result._reduce())
            whole.write_bytes(_checksum(key, content) + content)
            whole.replace(file)

    def _entry(self, signature: Any, codegen: Any) -> tuple[str, Path]:
        """What tells apart the function's versions in memory, and the file of this one."""
        key = f"{self._name} {signature} {codegen.magic_tuple()}"
        return key, self._folder / f"{self._name}-{sha256(key.encode()).hexdigest()[:20]}"


class LazyJit:
    """A function that runs as plain Python until it has done a given amount of work.

    After that, or as soon as its compiled form is found on disk, the compiled form runs. What the
    function calls must run both ways, as ``numba.extending.register_jitable`` makes it.

    Args:
        function: what to run.
        plain_work: how much work a process does as plain Python before it compiles, if the
            compiled function is not on disk yet; in any unit, such as epochs.
    """

    def __init__(self, function: Callable[..., Any], plain_work: int) -> None:
        self.plain, self.compiled = function, compiled(function)
        self._left = plain_work

    def choice(self, work: int, *arguments: Any) -> Callable[..., Any]:
        """The plain or the compiled function, for an amount of work with such arguments.

        Where threads share the work, choose once for all of them.
        """
        if work <= self._left and not is_compiled(self.compiled, arguments):
            self._left -= work
            return self.plain
        self._left = 0
        return self.compiled  # type: ignore[no-any-return]

    def __call__(self, work: int, *arguments: Any) -> Any:
        """Do an amount of work, as plain Python or compiled."""
        if not self._left:  # many steps come this way
            return self.compiled(*arguments)
        return self.choice(work, *arguments)(*arguments)
