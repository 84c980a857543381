"""Tests that a command replaces damaged or planted compiled functions, and never runs planted code.

test_disk_cache.py tests every check of these files separately, with a small package.
"""

import os
import pickle
import shutil
import subprocess
import sys

import pytest

from tests.cli import environment
from tests.paths import LOGS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs owners and modes of files"),
]
RAN = "planted code ran"
RECORDED = LOGS / "canyon28_vehicle"
LOCALIZE = ["localize", RECORDED / "log.csv", "--scene", RECORDED / "scene.json"]
LOCALIZE += ["--speed", "auto", "--out", "track.tum"]


class Planted:
    def __reduce__(self):
        return os.mkdir, (RAN,)


def flipped(content):
    """Return the content with one bit flipped."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]


DAMAGE = {
    "cut short": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "one bit flipped": flipped,
    "a planted pickle": lambda content: pickle.dumps(Planted()),
    "a planted pickle behind the checksum": lambda content: content[:32] + pickle.dumps(Planted()),
}


def localized(folder, cache):
    """Return the track that a new process makes with the compiled functions in ``cache``."""
    folder.mkdir()
    command = [sys.executable, "-m", "experiments.console", *map(str, LOCALIZE)]
    variables = environment() | {"NUMBA_CACHE_DIR": str(cache), "HOME": str(folder)}
    subprocess.run(command, cwd=folder, env=variables, capture_output=True, check=True)
    assert not (folder / RAN).exists()
    return (folder / "track.tum").read_bytes()


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """Return a folder of compiled functions, and the track that was made with them."""
    root = tmp_path_factory.mktemp("filled")
    return root / "cache", localized(root / "run", root / "cache")


@pytest.fixture
def cache(filled, tmp_path):
    return shutil.copytree(filled[0], tmp_path / "cache")


def entries(cache):
    files = sorted(cache.glob("*/*"))
    assert files
    return files


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_or_planted_function_is_compiled_anew(damage, cache, filled, tmp_path):
    before = entries(cache)
    for path in before:
        path.write_bytes(DAMAGE[damage](path.read_bytes()))
    damaged = [path.read_bytes() for path in before]
    assert localized(tmp_path / "run", cache) == filled[1]
    assert entries(cache) == before
    assert all(path.read_bytes() != old for path, old in zip(before, damaged, strict=True))
