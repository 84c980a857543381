"""Tests of the disk cache of compiled functions: versions, folders, and files of other users."""

import os
import sys
from pathlib import Path

import pytest

import mmwave_env
from tests import cli

pytestmark = pytest.mark.slow
SOURCES = {
    "__init__.py": "",
    "caller.py": (
        "from mmwave_env.own.room.callee import twice\n"
        "from mmwave_env.compiler.disk_cache import compiled\n"
        "@compiled\n"
        "def function(x):\n"
        "    return twice(x) + 1\n"
    ),
    "own/room/callee.py": "import numba\n@numba.njit\ndef twice(x):\n    return x * 2\n",
}
SCRIPT = """
from mmwave_env.caller import function
print(function(20), sum(function.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path):
    """Return the folder of a small installed package with a copy of disk_cache.py."""
    folder = tmp_path / "site" / "mmwave_env"
    own = Path(mmwave_env.__file__).parent / "compiler" / "disk_cache.py"
    for name, source in (SOURCES | {"compiler/disk_cache.py": own.read_text("utf-8")}).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(source, "utf-8")
    return folder


def started(package, script=SCRIPT, **variables):
    """Start a process that can import the package; HOME is the folder that contains ``site``."""
    home = package.parent.parent
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA", "XDG"))}
    # Write no bytecode: Python would still run it after an edit that keeps a file's time and size.
    own = {"PYTHONPATH": package.parent, "PYTHONDONTWRITEBYTECODE": "1", "HOME": home}
    every = {name: str(value) for name, value in (clean | own | variables).items()}
    return cli.started(program=("-c", script), env=every, cwd=home)


def finished(process):
    out, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return out.split()


def run(package, **variables):
    """Call the function in a new process; return its result and the number of loads from disk."""
    value, hits = finished(started(package, **variables))
    return int(value), int(hits)


def block(path):
    """Put a file where a folder would be made, so that not even root can make the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("")


def kept(package):
    """Return the files of compiled functions, wherever they are."""
    files = package.parent.parent.rglob("mmwave_env-*/*")
    return [path for path in files if path.is_file()]


def edit(path, old, new):
    """Change a source file but keep its time and size, as unpacking an archive may do."""
    stat = path.stat()
    source = path.read_text()
    assert source.count(old) == 1
    path.write_text(source.replace(old, new))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert (path.stat().st_size, path.stat().st_mtime_ns) == (stat.st_size, stat.st_mtime_ns)


def test_after_an_edit_old_code_is_never_used(package):
    assert run(package) == (41, 0)
    edit(package / "caller.py", "+ 1", "+ 2")
    assert run(package) == (42, 0)
    edit(package / "own/room/callee.py", "x * 2", "x * 3")
    assert run(package) == (62, 0)
    edit(package / "own/room/callee.py", "x * 3", "x * 2")
    assert run(package) == (42, 1)  # an earlier version, read from disk


EDITED = """
from pathlib import Path
from mmwave_env import caller
source = Path(caller.__file__).with_name("own") / "room" / "callee.py"
source.write_text(source.read_text().replace("x * 2", "x * 3"))
"""


def test_a_process_whose_sources_change_stores_nothing(package):
    """Check that old code is not stored under the name of the new code."""
    finished(started(package, EDITED + SCRIPT))
    assert kept(package) == []
    assert run(package) == (61, 0)


READ_ONLY = {  # name -> environment variables, number of files that are stored and loaded again
    "a writable home": ({}, 1),
    "no writable home": ({"HOME": "{tmp}/blocked"}, 0),
    "no writable folder for numba": ({"NUMBA_CACHE_DIR": "{tmp}/blocked"}, 1),
}


@pytest.mark.parametrize("case", READ_ONLY)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="uses folders of Linux")
def test_a_read_only_package_works(package, tmp_path, case):
    variables, hits = READ_ONLY[case]
    variables = {name: value.format(tmp=tmp_path) for name, value in variables.items()}
    for path in (package / "__pycache__", tmp_path / "blocked"):
        block(path)
    assert [run(package, **variables) for _ in range(2)] == [(41, 0), (41, hits)]
    assert len(kept(package)) == hits


FLIPS = """
import pickle
from pathlib import Path
from numba.core.registry import cpu_target
from mmwave_env.caller import function
from mmwave_env.compiler.disk_cache import compiled

function(20), function(2.0), function(2j)
cache, context = function._cache, cpu_target.target_context
entries = [cache._entry(signature, context.codegen())[1] for signature in function.signatures]
taken = checked = 0
for signature, entry in zip(function.signatures, entries):
    whole = entry.read_bytes()
    assert cache.load_overload(signature, context)
    for place in range(0, len(whole), 5):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        entry.write_bytes(damaged)
        taken += cache.load_overload(signature, context) is not None
        checked += 1
    for damaged in (b"", whole[: len(whole) // 2], whole[:32] + pickle.dumps(1)):
        entry.write_bytes(damaged)
        taken += cache.load_overload(signature, context) is not None
again = compiled(function.py_func)
print(len(entries), taken, checked, again(20), again(2.0), again(2j))
print(sum(again.stats.cache_hits.values()))
"""


def test_a_damaged_file_is_never_loaded(package):
    entries, taken, checked, *values, hits = finished(started(package, FLIPS))
    assert (entries, taken, values, hits) == ("3", "0", ["41", "5.0", "(1+4j)"], "0")
    assert int(checked) > 3000
    assert run(package) == (41, 1)


def test_several_processes_can_start_simultaneously(package):
    together = [started(package) for _ in range(4)]
    assert {finished(process)[0] for process in together} == {"41"}
    assert len(kept(package)) == 1
    assert run(package) == (41, 1)


PLANT = """
import os
from types import SimpleNamespace
from numba.core.registry import cpu_target
from mmwave_env.caller import function

class Planted:
    def __reduce__(self):
        return os.mkdir, ("planted code ran",)

function(20)
function._cache.save_overload(function.signatures[0], SimpleNamespace(
    library=SimpleNamespace(has_dynamic_globals=False),
    codegen=cpu_target.target_context.codegen(),
    _reduce=Planted,
))
"""


@pytest.fixture
def planted(package, tmp_path):
    """Return a file, stored in a shared folder, that runs planted code when it is loaded."""
    shared = tmp_path / "shared"
    finished(started(package, PLANT, NUMBA_CACHE_DIR=shared))
    (file,) = shared.glob("*/*")
    return file


def given_away(path):
    """Make another user the owner of a path; without root's rights, return code that fakes this."""
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        os.chown(path, 65534, 65534)
        return ""
    return (
        "import os\n"
        "def seen(see):\n"
        "    def other(*args, **kwargs):\n"
        "        found = see(*args, **kwargs)\n"
        "        uid = found.st_uid + (found.st_ino == " + str(path.stat().st_ino) + ")\n"
        "        return os.stat_result((*found[:4], uid, *found[5:]))\n"
        "    return other\n"
        "os.lstat, os.fstat = seen(os.lstat), seen(os.fstat)\n"
    )


def linked(path):
    """Move a file to a new private folder, and leave a link in its place."""
    private = path.parent.parent / "private"
    private.mkdir(mode=0o700)
    path.symlink_to(path.rename(private / path.name))


UNTRUSTED = {
    "a folder of another user": lambda file: given_away(file.parent),
    "a file of another user": given_away,
    "a folder the group may write to": lambda file: file.parent.chmod(0o770),
    "a file everyone may write to": lambda file: file.chmod(0o606),
    "a link to a folder": lambda file: linked(file.parent),
    "a link to a file": linked,
}
posix = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs owners and modes of files")


def test_a_file_of_the_same_user_is_loaded(package, tmp_path, planted):
    assert run(package, NUMBA_CACHE_DIR=planted.parent.parent) == (41, 0)
    assert (tmp_path / "planted code ran").exists()  # otherwise the next test proves nothing


@posix
@pytest.mark.parametrize("case", UNTRUSTED)
def test_a_file_that_others_may_have_written_is_not_loaded(package, tmp_path, planted, case):
    script = (UNTRUSTED[case](planted) or "") + SCRIPT
    shared = planted.parent.parent
    runs = [finished(started(package, script, NUMBA_CACHE_DIR=shared)) for _ in range(2)]
    assert not (tmp_path / "planted code ran").exists()
    assert runs == [["41", "0"], ["41", "1"]]


@posix
def test_stored_files_are_private_but_are_loaded_even_if_others_may_read_them(package):
    process = started(package, "import os\nos.umask(0)\n" + SCRIPT)
    assert finished(process) == ["41", "0"]
    (file,) = kept(package)
    assert [path.stat().st_mode & 0o777 for path in (file.parent, file)] == [0o700, 0o600]
    file.parent.chmod(0o755)
    file.chmod(0o644)
    assert run(package) == (41, 1)


@posix
def test_cleaning_deletes_only_unused_old_folders_of_the_same_user(package, tmp_path):
    shared = tmp_path / "shared"
    precious = tmp_path / "precious"
    assert run(package, NUMBA_CACHE_DIR=shared) == (41, 0)
    (used,) = shared.iterdir()
    os.utime(used, (0, 0))
    for age, folder in enumerate([precious, *[shared / f"mmwave_env-{n}" for n in range(1, 31)]]):
        folder.mkdir()
        (folder / "content").write_text("")
        os.utime(folder, (age + 1, age + 1))
    (shared / "mmwave_env-link").symlink_to(precious)
    script = given_away(shared / "mmwave_env-1") + SCRIPT
    assert finished(started(package, script, NUMBA_CACHE_DIR=shared)) == ["41", "1"]
    left = {path.name for path in shared.iterdir()}
    assert {used.name, "mmwave_env-30", "mmwave_env-1"} < left
    assert "mmwave_env-link" in left and (precious / "content").exists()
    assert "mmwave_env-2" not in left and len(left) < 15
    assert run(package, NUMBA_CACHE_DIR=shared) == (41, 1)
