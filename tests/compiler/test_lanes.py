"""Tests that functions, filters and simulations give equal results on SIMD lanes and in Python."""

import math
import platform
import re
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.compiler import disk_cache
from mmwave_env.compiler.lanes import WIDTH, kernel
from mmwave_env.compiler.program import Program
from mmwave_env.numerics.numbers import (
    atan2,
    clip,
    cos_sin,
    exp,
    log,
    maximum,
    minimum,
    sqrt,
    where,
    wrap,
)
from tests.filters.tracks import assert_same_beliefs, pipeline_of, simulated, track
from tests.paths import representative


class Many(NamedTuple):
    """Workspace with more values than a processor has registers."""

    incoming: list
    x: list


NAN = math.nan
INF = math.inf


@cache
def compiled(function, arity):
    """Compile a kernel that applies a function to ``arity`` rows and writes the next row."""

    def write(rows):
        *arguments, _ = rows
        return [*arguments, function(*arguments)]

    run = kernel(write, [0.0] * (arity + 1))

    @numba.njit
    def main(blocks):
        for b in range(len(blocks)):
            run((blocks[b].ctypes.data,))

    return main


def on_lanes(function, *columns):
    """Apply a function to columns of floats on lanes, eight at a time, and return the results."""
    columns = np.broadcast_arrays(*[np.asarray(c, float) for c in columns])
    n = columns[0].size
    blocks = np.ones((-(-n // WIDTH), len(columns) + 1, WIDTH))
    for i, column in enumerate(columns):
        blocks[:, i, :].flat[:n] = column.ravel()
    compiled(function, len(columns))(blocks)
    return blocks[:, len(columns), :].ravel()[:n]


def floats(low, high):
    """Return a strategy for 64 floats that are neither subnormal nor -0."""
    # Adding 0 turns -0 into 0; for -0, the sign of atan2 may differ from numpy's.
    elements = st.floats(low, high, allow_subnormal=False).map(lambda a: a + 0.0)
    return hnp.arrays(float, 64, elements=elements)


def cosine(a):
    return cos_sin(a)[0]


def sine(a):
    return cos_sin(a)[1]


def clip_to_unit(a):
    return clip(a, -1.0, 1.0)


def mixed_arithmetic(a, b):
    return 2.0 - (-a + 0.0 * b) * 1.0 + (b - 3.0) / 7.0 + (0.0 + a) - 1.0 / (1.0 + b * b)


ANY = (-1e9, 1e9)
FUNCTIONS = {  # function on lanes -> function of numpy, limits of the arguments, rtol, atol
    sqrt: (np.sqrt, [(0.0, 1e300)], 0.0, 0.0),
    log: (np.log, [(1e-300, 1e300)], 4e-16, 4e-16),
    exp: (np.exp, [(-700.0, 700.0)], 1e-15, 0.0),
    atan2: (np.arctan2, [(-1e100, 1e100)] * 2, 1e-15, 1e-300),
    cosine: (np.cos, [(-1e5, 1e5)], 1e-15, 2e-16),
    sine: (np.sin, [(-1e5, 1e5)], 1e-15, 2e-16),
    wrap: (np.vectorize(wrap), [(-3 * math.pi, 3 * math.pi)], 0.0, 0.0),
    minimum: (np.minimum, [ANY, ANY], 0.0, 0.0),
    maximum: (np.maximum, [ANY, ANY], 0.0, 0.0),
    abs: (np.abs, [ANY], 0.0, 0.0),
    clip_to_unit: (lambda a: np.clip(a, -1.0, 1.0), [ANY], 0.0, 0.0),
    mixed_arithmetic: (mixed_arithmetic, [ANY, ANY], 1e-12, 1e-6),
}


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
@settings(max_examples=50)
@given(data=st.data())
def test_functions_on_lanes_agree_with_numpy(function, data):
    expected, limits, rtol, atol = FUNCTIONS[function]
    columns = [data.draw(floats(*limit)) for limit in limits]
    results = on_lanes(function, *columns)
    assert_allclose(results, expected(*columns), rtol=rtol, atol=atol)
    assert function is not wrap or np.all(np.abs(results) <= math.pi)


ANGLE = np.linspace(-math.pi, math.pi, 100_001)
CIRCLE = [np.sin(ANGLE), np.cos(ANGLE)]  # y, x
LARGE = [-INF, -1e6, -709.0, 709.0, 1e6, INF]
CLIPPED = [-708.0] * 3 + [708.0] * 3
EDGE = [[0, 1, 1, 1, 0, -1, -1, -1], [1, 1, 0, -1, -1, -1, 0, 1]]  # y, x of axes and diagonals
EDGES = np.concatenate([scale * np.array(EDGE) for scale in (1e-200, 1.0, 1e200)], axis=1)
CUT = [1e-300, -1e-300, 1e-17, -1e-17]
NEXT_TO_ONE = 1.0 + np.outer([1.0, -1.0], np.logspace(-15, -0.5, 500)).ravel()
TURNS = np.concatenate([4.0 * ANGLE, (math.pi / 2) * np.arange(-8, 9)])
SPECIAL = {  # name -> function, arguments, expected, rtol, atol
    "log next to 1": (log, [NEXT_TO_ONE], np.log(NEXT_TO_ONE), 1e-15, 0.0),
    "exp of arguments beyond 708": (exp, [LARGE], np.exp(CLIPPED), 1e-12, 0.0),
    "atan2 all around a circle": (atan2, CIRCLE, np.arctan2(*CIRCLE), 5e-16, 1e-16),
    "atan2 on axes and diagonals": (atan2, EDGES, np.tile(np.arctan2(*EDGE), 3), 1e-15, 0.0),
    "atan2 next to the branch cut": (atan2, [CUT, -1.0], [math.pi, -math.pi] * 2, 1e-15, 0.0),
    "atan2 of zeros": (atan2, [[0.0], [0.0]], [math.atan2(0.0, 0.0)], 0.0, 0.0),
    "cosine of all angles and of quarter turns": (cosine, [TURNS], np.cos(TURNS), 3e-16, 1e-18),
    "sine of all angles and of quarter turns": (sine, [TURNS], np.sin(TURNS), 3e-16, 1e-18),
}


@pytest.mark.parametrize("name", SPECIAL)
def test_functions_on_lanes_are_accurate_at_special_arguments(name):
    function, arguments, expected, rtol, atol = SPECIAL[name]
    assert_allclose(on_lanes(function, *arguments), expected, rtol=rtol, atol=atol)


COMPARISONS = {
    "<": lambda a, b: where(a < b, 1.0, 0.0),
    "<=": lambda a, b: where(a <= b, 1.0, 0.0),
    ">": lambda a, b: where(a > b, 1.0, 0.0),
    ">=": lambda a, b: where(a >= b, 1.0, 0.0),
    "and": lambda a, b: where((a > -1.0) & (b < 1.0), 1.0, 0.0),
    "or": lambda a, b: where((a < -1.0) | (b > 1.0), 1.0, 0.0),
}


@pytest.mark.parametrize("compare", COMPARISONS.values(), ids=COMPARISONS)
def test_comparisons_of_lanes_equal_comparisons_of_floats_even_with_nan(compare):
    values = [-INF, -1.0, 0.0, 1.0, INF, NAN]
    a, b = (grid.ravel() for grid in np.meshgrid(values, values))
    expected = [compare(float(u), float(v)) for u, v in zip(a, b, strict=True)]
    assert_array_equal(on_lanes(compare, a, b), expected)


def test_where_ignores_nan_in_the_other_branch():
    guarded = on_lanes(lambda a: where(a >= 0.0, sqrt(a), -1.0), [-1.0, 4.0, NAN, 0.0])
    assert_array_equal(guarded, [-1.0, 2.0, -1.0, 0.0])


OPTIONS = {
    "default": {},
    "no gate": {"gate": None},
    "blockage aware": {"blockage_aware": True, "spread_gain": 0.01},
    "robust": {"robust": True},
    "plain diagonal": {"coupling": False},
    "not adaptive": {"adaptive": False, "recovery": None},
    "recovery": {"sigma_v": 0.1, "sigma_p": 0.01},
}
ALL = ("ekf", "ukf", "ckf")
KEPT = ("x", "P", "P_predicted", "memory", "candidates", "observation", "reward", "error", "nees")
KEPT += ("memory.accepted", "memory.lockout")


def assert_floats_equal_lanes(pipeline, episodes, actions):
    """Check that floats and lanes agree up to rounding; return the results on lanes."""
    epochs = len(episodes[0])
    a = track(pipeline, episodes, actions, epochs, KEPT, False)
    b = track(pipeline, episodes, actions, epochs, KEPT, True)
    assert_same_beliefs(a, b, rtol=1e-12)
    assert_same_beliefs(*[{"x": t["x"], "P": t["P_predicted"]} for t in (a, b)], rtol=1e-12)
    for name in KEPT[3:]:
        assert_allclose(a[name], b[name], rtol=1e-9, atol=1e-9, err_msg=name)
    assert_array_equal(a["memory.accepted"], b["memory.accepted"])
    return a


@pytest.mark.parametrize("name", representative(OPTIONS, "default"))  # each case compiles
def test_filters_on_lanes_equal_filters_on_floats(name):
    """Run each filter alone, and with random switching between the filters."""
    actions = np.random.default_rng(0).integers(3, size=(60, 5))
    actions[:, :3] = range(3)
    pipeline = pipeline_of(algorithms=ALL, **OPTIONS[name])
    lanes = assert_floats_equal_lanes(pipeline, simulated(5, epochs=60), actions)
    if name == "recovery":
        assert lanes["memory.lockout"].max() > 2.0


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.slow
def test_odometry_on_lanes_equals_odometry_on_floats(planar):
    """Start the filters with a velocity of zero, for which the heading is not defined."""
    episodes = [
        replace(episode, prior_mean=episode.prior_mean * [1, 1, 1, 0, 0, 0, 1])
        for episode in simulated(3, epochs=60, odometry=True)
    ]
    pipeline = pipeline_of(episodes[0].layout, ALL, planar)
    assert_floats_equal_lanes(pipeline, episodes, np.arange(3))


@pytest.mark.parametrize("n", [1, 3, 8, 13])
def test_results_do_not_depend_on_other_episodes_or_on_their_order(n):
    pipeline = pipeline_of()
    episodes = simulated(13, epochs=60)
    actions = np.random.default_rng(1).integers(3, size=(60, 13))
    order = np.random.default_rng(n).permutation(13)[:n]
    everyone = track(pipeline, episodes, actions, 60, KEPT)
    some = track(pipeline, [episodes[i] for i in order], actions[:, order], 60, KEPT)
    for name in KEPT:
        assert_array_equal(some[name], everyone[name][:, order], err_msg=name)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86 assembly")
def test_the_stack_of_a_kernel_is_aligned(monkeypatch):
    monkeypatch.setattr(disk_cache, "_folder", lambda: None)  # kernels from disk have no assembly
    program = Program(lambda w: w._replace(x=[sum(w.x) * v for v in w.x]), Many([0.0], [1.0] * 60))
    program.on_lanes()
    code = program._compiled._library.get_asm_str()
    assert re.search(r"and[q]?\s+\$-64, %rsp", code)
