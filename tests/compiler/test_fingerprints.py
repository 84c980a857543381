"""Tests that kernels on disk are named after what they compute, not after their source code."""

import textwrap
from typing import Any, NamedTuple

import pytest

from mmwave_env.numerics.numbers import atan2, cos_sin, sqrt, where
from mmwave_env.numerics.tape import fingerprint
from tests.cli import printed


class Pair(NamedTuple):
    x: Any
    y: Any


def name_of(change):
    return fingerprint(lambda w: w._replace(x=change(w.x, w.y)), Pair(0.0, 0.0))


FUNCTIONS = {
    "x": lambda x, y: x,
    "y": lambda x, y: y,
    "constant": lambda x, y: 1.0,
    "sum": lambda x, y: x + y,
    "sum in reverse order": lambda x, y: y + x,
    "difference": lambda x, y: x - y,
    "root": lambda x, y: sqrt(x),
    "angle": lambda x, y: atan2(x, y),
    "angle of a constant": lambda x, y: atan2(2.0, y),
    "cosine": lambda x, y: cos_sin(x)[0],
    "sine": lambda x, y: cos_sin(x)[1],
    "where": lambda x, y: where(x < y, x, y),
    "both": lambda x, y: where((x < y) & (x < 0.0), x, y),
    "tenth": lambda x, y: x * 0.1,
    "next to a tenth": lambda x, y: x * 0.10000000000000002,
    "zero": lambda x, y: where(x < y, 0.0, x),
    "negative zero": lambda x, y: where(x < y, -0.0, x),
}


def test_functions_that_compute_different_things_have_different_names():
    names = {name: name_of(function) for name, function in FUNCTIONS.items()}
    assert len(set(names.values())) == len(names)


def test_functions_that_compute_the_same_have_the_same_name():
    def double(x, y):
        both = [x, y]
        return sum(both[1:], start=both[0])

    assert name_of(double) == name_of(FUNCTIONS["sum"])
    assert len(name_of(double)) == 20


def test_the_name_depends_on_rows_that_are_only_passed_through():
    swapped = fingerprint(lambda w: Pair(w.y, w.x), Pair(0.0, 0.0))
    kept = fingerprint(lambda w: w, Pair(0.0, 0.0))
    longer = fingerprint(lambda w: w, [0.0, 0.0, 0.0])
    assert len({swapped, kept, longer}) == 3


@pytest.fixture
def started(tmp_path, monkeypatch):
    """Return a function that runs code in a new process, which keeps kernels in the test's folder.

    The function returns the words that the process prints.
    """
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))

    def run(code):
        return printed(textwrap.dedent(code)).split()

    run.kernels = lambda: sorted((tmp_path / "kept").glob("*/*.Program.*"))
    return run


PROGRAMS = """
    from ctypes import CFUNCTYPE, c_int64
    from typing import Any, NamedTuple
    import numpy as np
    from mmwave_env.compiler.program import Program
    class Pair(NamedTuple):
        incoming: list[Any]
        x: Any
    def shown(change):
        program = Program(lambda w: w._replace(x=change(w.x)), Pair([], 0.0))
        block = np.ones((1, 8))
        CFUNCTYPE(None, c_int64)(program.on_lanes())(block.ctypes.data)
        print(block[0, 3], program._compiled._cache_hits)
"""


@pytest.mark.slow
def test_kernels_of_several_processes_are_not_mixed_up(started):
    """Compile each kernel in its own process, then load all kernels in a single process.

    If kernels had equal names, the last process would load a wrong one. Each process prints each
    kernel's result for 1, and how many times the kernel was found on disk.
    """
    changes = ["lambda x: x + 4.0", "lambda x: x * 3.0", "lambda x: x - 7.0"]
    for change, value in zip(changes, ["5.0", "3.0", "-6.0"], strict=True):
        assert started(PROGRAMS + f"    shown({change})") == [value, "0"]
    assert len(started.kernels()) == 3
    together = "".join(f"    shown({change})\n" for change in changes)
    assert started(PROGRAMS + together) == ["5.0", "1", "3.0", "1", "-6.0", "1"]


@pytest.mark.slow
def test_an_environment_reuses_its_kernels_except_for_a_new_reward(started):
    """Check that rewards are bit-identical, and that a new reward gets its own kernel."""
    code = """
        import gymnasium as gym
        def reward(belief, truth):
            return {} * belief.error(truth)[0]
        env = gym.make("mmwave_env:MmWaveLoc-v0", reward=reward)
        env.reset(seed=0)
        print(*(repr(float(env.step(0)[1])) for _ in range(50)))
    """
    first = started(code.format("1.0"))
    kernels = started.kernels()
    assert started(code.format("1.0")) == first
    assert started.kernels() == kernels
    twice = started(code.format("2.0"))
    assert [float(r) for r in twice] == pytest.approx([2.0 * float(r) for r in first])
    assert len(started.kernels()) == len(kernels) + 1
