"""Compiled functions damaged, planted and shared: a command comes to the same and runs no plants.

What each check of a file is for is in tests/compiler/test_disk_cache.py; here are real ones.
"""

import os
import pickle
import shutil
import time

import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("pyarrow")

from tests.faults.cases import CASES
from tests.faults.child import Child

pytestmark = [
    pytest.mark.torch,
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no owners and modes of files"),
]
RAN = "planted code ran"


class Planted:
    def __reduce__(self):
        return os.mkdir, (RAN,)


def flipped(content):
    """With one bit of another value."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]


DAMAGE = {
    "cut short": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "one bit flipped": flipped,
    "a plant": lambda content: pickle.dumps(Planted()),
    "a plant behind the checksum": lambda content: content[:32] + pickle.dumps(Planted()),
}


def localized(folder, cache):
    """What localize comes to in a new interpreter with these compiled functions."""
    case = CASES["localize"]()
    case.begin(folder, {})
    variables = {"NUMBA_CACHE_DIR": str(cache), "HOME": str(cache.parent)}
    code, told, _ = Child(case.words, folder, fresh=True, variables=variables).ended()
    assert code == 0, told
    assert not (folder / RAN).exists()
    return case.results(folder)


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    """Compiled functions, and what localize comes to with them."""
    root = tmp_path_factory.mktemp("filled")
    return root / "cache", localized(root / "run", root / "cache")


@pytest.fixture
def cache(filled, tmp_path):
    """A copy of them."""
    return shutil.copytree(filled[0], tmp_path / "cache")


def entries(cache):
    return sorted(cache.glob("*/*"))


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_or_planted_function_is_compiled_anew(damage, cache, filled, tmp_path):
    before = entries(cache)
    assert before
    for path in before:
        path.write_bytes(DAMAGE[damage](path.read_bytes()))
    damaged = [path.read_bytes() for path in before]
    assert localized(tmp_path / "run", cache) == filled[1]
    assert entries(cache) == before
    assert all(path.read_bytes() != old for path, old in zip(before, damaged, strict=True))


def test_a_shared_folder_is_left_alone(cache, filled, tmp_path):
    for path in entries(cache):
        path.parent.chmod(0o777)
        path.write_bytes(pickle.dumps(Planted()))
    before = [path.read_bytes() for path in entries(cache)]
    assert localized(tmp_path / "run", cache) == filled[1]
    assert [path.read_bytes() for path in entries(cache)] == before


def test_functions_from_the_future_are_as_good(cache, filled, tmp_path):
    """As they look when the clock was set back."""
    later = time.time() + 1e8
    for path in entries(cache):
        os.utime(path, (later, later))
    before = [path.read_bytes() for path in entries(cache)]
    assert localized(tmp_path / "run", cache) == filled[1]
    assert [path.read_bytes() for path in entries(cache)] == before
