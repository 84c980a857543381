"""Compiled functions, kept on disk for the next process and never out of date.

numba's ``cache=True`` looks at the file of the function alone, so it answers with old code once
a function it calls was edited in another file; some versions miss edits that keep time and
size, too. Processes that start at once can mix up its files, and a damaged file or a full disk
ends the program. Here a folder is named after all sources, each compiled function is one file
in it, and whatever goes wrong with a file means that the function is compiled anew. The files
are pickles, as numba's own are, and trusted as much as the bytecode that lies beside them.
"""

import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from os.path import getmtime
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.registry import cpu_target
from numba.core.serialize import dumps
from numba.misc.appdirs import user_cache_dir

_PACKAGE = Path(__file__).parent
_KEPT = 8  # versions of the sources whose compiled functions stay


def compiled(function: Callable[..., Any]) -> Any:
    """A function of a module, compiled by numba to run without the interpreter's lock.

    For what Python calls; functions that only compiled ones call need ``numba.njit`` alone.
    """
    dispatcher = numba.njit(nogil=True)(function)
    folder = _folder()
    if folder is not None:
        dispatcher._cache = _Kept(function, folder)
    return dispatcher


def is_compiled(function: Any, arguments: tuple[Any, ...]) -> bool:
    """Whether a :func:`compiled` function is there for such arguments, in memory or on disk."""
    signature, cache = tuple(map(numba.typeof, arguments)), function._cache
    return signature in function.overloads or (isinstance(cache, _Kept) and cache.has(signature))


def _folder() -> Path | None:
    """Where this version's functions are kept; None where nothing can be written.

    In numba's own ``NUMBA_CACHE_DIR`` if it is set; beside Python's bytecode, if the package
    is writable; else in the user's folder for caches.
    """
    version = _version()
    if version is None:
        return None
    places = [_PACKAGE / "__pycache__", Path(user_cache_dir("mmwave-env", appauthor=False))]
    if numba.config.CACHE_DIR:
        places.insert(0, Path(numba.config.CACHE_DIR).absolute())
    for place in places:
        folder = place / f"{_PACKAGE.name}-{version}"
        with suppress(OSError):
            if not place.is_absolute():  # nobody's home
                continue
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)  # in use now, which mkdir does not note where it is there
            tempfile.TemporaryFile(dir=folder).close()
            for old in sorted(place.glob(f"{_PACKAGE.name}-*"), key=getmtime)[:-_KEPT]:
                shutil.rmtree(old, ignore_errors=True)
            return folder
    return None


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
        return self._entry(signature, cpu_target.target_context.codegen())[1].exists()

    def load_overload(self, signature: Any, context: Any) -> Any:
        context.refresh()
        key, file = self._entry(signature, context.codegen())
        with suppress(Exception):  # none yet, or a damaged one
            found, reduced = pickle.loads(file.read_bytes())
            if found == key:
                return CompileResult._rebuild(context, *reduced)
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        if result.library.has_dynamic_globals:  # addresses of this process
            return
        key, file = self._entry(signature, result.codegen)
        with suppress(OSError), tempfile.TemporaryDirectory(dir=self._folder) as beside:
            whole = Path(beside, file.name)
            whole.write_bytes(dumps((key, result._reduce())))
            whole.replace(file)

    def _entry(self, signature: Any, codegen: Any) -> tuple[str, Path]:
        """What tells apart the function's versions in memory, and the file of this one."""
        key = f"{self._name} {signature} {codegen.magic_tuple()}"
        return key, self._folder / f"{self._name}-{sha256(key.encode()).hexdigest()[:20]}"
