"""Tests that plain and compiled functions copy numbers between tables and lanes correctly."""

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from mmwave_env.compiler import lanes as tiles
from mmwave_env.compiler.lanes import WIDTH
from tests.cli import printed

SIZE = 50
COUNTS = st.integers(0, SIZE)


# Called from Python, the functions of ``tiles`` run as plain Python; these wrappers compile them.
compiled_gather = numba.njit(lambda block, sources, count: tiles.gather(block, sources, count))
compiled_scatter = numba.njit(lambda block, rows, targets: tiles.scatter(block, rows, targets))
compiled_scatter_single = numba.njit(
    lambda block, rows, targets: tiles.scatter_single(block, rows, targets)
)


def some_block(seed):
    return np.random.default_rng(seed).normal(size=(SIZE, WIDTH))


def addresses(table):
    """Return the addresses of the rows of a table (8, n), the last row first."""
    return table.ctypes.data + table.strides[0] * np.arange(WIDTH, dtype=np.int64)[::-1]


@pytest.mark.parametrize("gather", [tiles.gather, compiled_gather])
@given(count=COUNTS, seed=st.integers(0, 99))
def test_gather_reads_every_lane_from_its_own_address(gather, count, seed):
    table = np.random.default_rng(seed).normal(size=(WIDTH, count + 1))
    block = some_block(seed)
    expected = block.copy()
    expected[:count] = table[::-1, :count].T
    gather(block, addresses(table), count)
    assert_array_equal(block, expected)


@pytest.mark.parametrize(
    ("scatter", "dtype"),
    [
        (tiles.scatter, np.float64),
        (compiled_scatter, np.float64),
        (tiles.scatter_single, np.float32),
        (compiled_scatter_single, np.float32),
    ],
)
@given(rows=st.lists(st.integers(0, SIZE - 1), max_size=30), seed=st.integers(0, 99))
def test_scatter_writes_the_rows_and_nothing_else(scatter, dtype, rows, seed):
    block = some_block(seed)
    room = np.full((WIDTH, len(rows) + 3), 7.0, dtype)
    expected = room.copy()
    expected[::-1, : len(rows)] = block[rows].T
    scatter(block, np.array(rows, np.int64), addresses(room))
    assert_array_equal(room, expected)


USERS = """
import numpy as np
from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.compiler.lanes import scatter, scatter_single

@compiled
def wide(block, rows, targets):
    scatter(block, rows, targets)

@compiled
def narrow(block, rows, targets):
    scatter_single(block, rows, targets)

def out_of(function, kind):
    block, out = np.arange(80.0).reshape(10, 8), np.zeros((8, 30), kind)
    targets = out.ctypes.data + out.strides[0] * np.arange(8)
    function(block, np.arange(10), targets)
    assert (out[:, :10] == block.T).all() and (out[:, 10:] == 0).all(), out
"""


@pytest.mark.slow
def test_functions_stored_by_two_processes_work_in_a_third(tmp_path, monkeypatch):
    """Check that symbols do not collide although each process numbers its functions anew."""
    (tmp_path / "users.py").write_text(USERS)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    wide = "out_of(wide, np.float64)"
    narrow = "out_of(narrow, np.float32)"
    for calls in (wide, narrow, f"{wide}; {narrow}"):
        printed(f"from users import *; {calls}", cwd=tmp_path)
