"""Tests that SIMD lanes compute the same as floats: functions, comparisons, filters, the world."""

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

from mmwave_env.compiler import disk_cache
from mmwave_env.compiler.lanes import WIDTH, Lanes, Mask, kernel
from mmwave_env.compiler.program import Program
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
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
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.numerics.tape import taped
from mmwave_env.world.mobility import MOBILITIES
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import assert_same_beliefs, pipeline_of, simulated, track
from tests.paths import representative


class Many(NamedTuple):
    """A workspace of more values than a processor has registers."""

    incoming: list
    x: list


NAN, INF = math.nan, math.inf


@cache
def compiled(function, arity):
    """Compile a function of ``arity`` numbers to run on lanes; the result takes blocks of lanes."""

    def build(rows):
        rows[arity] = function(*(rows[i] for i in range(arity)))

    run = kernel(build, [arity + 1])

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


def close(actual, expected, rtol=1e-15, atol=0.0):
    np.testing.assert_allclose(actual, expected, rtol=rtol, atol=atol)


def floats(low, high):
    """Return a strategy for 64 floats: none subnormal, and no -0 (its atan2 may differ in sign)."""
    elements = st.floats(low, high, allow_subnormal=False).map(lambda a: a + 0.0)
    return hnp.arrays(float, 64, elements=elements)


drawn = settings(max_examples=50, deadline=None)


class TestElementaryFunctions:
    @drawn
    @given(a=floats(0.0, 1e300))
    def test_sqrt_is_correctly_rounded(self, a):
        np.testing.assert_array_equal(on_lanes(sqrt, a), np.sqrt(a))

    @drawn
    @given(a=floats(1e-300, 1e300))
    def test_log_agrees_with_numpy(self, a):
        close(on_lanes(log, a), np.log(a), rtol=4e-16, atol=4e-16)

    def test_log_is_accurate_near_one(self):
        a = 1.0 + np.concatenate([np.logspace(-15, -0.5, 500), -np.logspace(-15, -0.5, 500)])
        close(on_lanes(log, a), np.log(a), rtol=1e-15)

    @drawn
    @given(a=floats(-700.0, 700.0))
    def test_exp_agrees_with_numpy(self, a):
        close(on_lanes(exp, a), np.exp(a), rtol=1e-15)

    def test_exp_is_clipped_instead_of_overflowing(self):
        a = [-INF, -1e6, -709.0, 709.0, 1e6, INF]
        close(on_lanes(exp, a), np.exp([-708.0] * 3 + [708.0] * 3), rtol=1e-12)

    @drawn
    @given(y=floats(-1e100, 1e100), x=floats(-1e100, 1e100))
    def test_atan2_agrees_with_numpy_anywhere(self, y, x):
        y = np.where((x == 0.0) & (y == 0.0), 1.0, y)
        close(on_lanes(atan2, y, x), np.arctan2(y, x), rtol=1e-15, atol=1e-300)

    def test_atan2_agrees_with_numpy_all_around_a_circle(self):
        angle = np.linspace(-math.pi, math.pi, 100_001)
        y, x = np.sin(angle), np.cos(angle)
        close(on_lanes(atan2, y, x), np.arctan2(y, x), rtol=5e-16, atol=1e-16)

    @pytest.mark.parametrize("scale", [1e-200, 1.0, 1e200])
    def test_atan2_agrees_with_numpy_on_axes_and_diagonals(self, scale):
        y, x = scale * np.array([[0, 1, 1, 1, 0, -1, -1, -1], [1, 1, 0, -1, -1, -1, 0, 1]])
        close(on_lanes(atan2, y, x), np.arctan2(y, x))

    def test_atan2_has_the_right_sign_next_to_the_branch_cut(self):
        y = np.array([1e-300, -1e-300, 1e-17, -1e-17])
        close(on_lanes(atan2, y, -1.0), [math.pi, -math.pi, math.pi, -math.pi])

    def test_atan2_of_zeros_is_zero(self):
        assert on_lanes(atan2, [0.0], [0.0]) == math.atan2(0.0, 0.0)

    @drawn
    @given(a=floats(-1e5, 1e5))
    def test_cos_sin_agrees_with_numpy(self, a):
        close(on_lanes(cosine, a), np.cos(a), atol=2e-16)
        close(on_lanes(sine, a), np.sin(a), atol=2e-16)

    def test_cos_sin_agrees_with_numpy_all_around_and_at_quarter_turns(self):
        quarters = (math.pi / 2) * np.arange(-8, 9)
        a = np.concatenate([np.linspace(-4 * math.pi, 4 * math.pi, 100_001), quarters])
        close(on_lanes(cosine, a), np.cos(a), rtol=3e-16, atol=1e-18)
        close(on_lanes(sine, a), np.sin(a), rtol=3e-16, atol=1e-18)

    @drawn
    @given(a=floats(-3 * math.pi, 3 * math.pi))
    def test_wrap_equals_that_of_floats(self, a):
        wrapped = on_lanes(wrap, a)
        assert np.all(np.abs(wrapped) <= math.pi)
        np.testing.assert_array_equal(wrapped, [wrap(value) for value in a])

    @drawn
    @given(a=floats(-1e9, 1e9), b=floats(-1e9, 1e9))
    def test_minimum_maximum_clip_and_abs_equal_those_of_numpy(self, a, b):
        np.testing.assert_array_equal(on_lanes(minimum, a, b), np.minimum(a, b))
        np.testing.assert_array_equal(on_lanes(maximum, a, b), np.maximum(a, b))
        np.testing.assert_array_equal(on_lanes(abs, a), np.abs(a))
        np.testing.assert_array_equal(on_lanes(clip_to_unit, a), np.clip(a, -1.0, 1.0))

    @drawn
    @given(a=floats(-1e9, 1e9), b=floats(-1e9, 1e9))
    def test_arithmetic_with_lanes_and_constants_agrees_with_numpy(self, a, b):
        close(on_lanes(mixed_arithmetic, a, b), mixed_arithmetic(a, b), rtol=1e-12, atol=1e-6)


def cosine(a):
    return cos_sin(a)[0]


def sine(a):
    return cos_sin(a)[1]


def clip_to_unit(a):
    return clip(a, -1.0, 1.0)


def mixed_arithmetic(a, b):
    return 2.0 - (-a + 0.0 * b) * 1.0 + (b - 3.0) / 7.0 + (0.0 + a) - 1.0 / (1.0 + b * b)


COMPARISONS = {
    "<": lambda a, b: where(a < b, 1.0, 0.0),
    "<=": lambda a, b: where(a <= b, 1.0, 0.0),
    ">": lambda a, b: where(a > b, 1.0, 0.0),
    ">=": lambda a, b: where(a >= b, 1.0, 0.0),
}


class TestComparisons:
    @pytest.mark.parametrize("compare", COMPARISONS.values(), ids=COMPARISONS)
    def test_comparisons_equal_those_of_floats_and_are_false_with_nan(self, compare):
        values = [-INF, -1.0, 0.0, 1.0, INF, NAN]
        a, b = (grid.ravel() for grid in np.meshgrid(values, values))
        expected = [compare(float(u), float(v)) for u, v in zip(a, b, strict=True)]
        np.testing.assert_array_equal(on_lanes(compare, a, b), expected)

    def test_where_ignores_nan_in_the_other_branch(self):
        a = [-1.0, 4.0, NAN, 0.0]
        guarded = on_lanes(root_or_minus_one, a)
        np.testing.assert_array_equal(guarded, [-1.0, 2.0, -1.0, 0.0])

    def test_masks_can_be_combined_with_and_and_or(self):
        a = np.array([-2.0, -0.5, 0.5, 2.0, NAN])
        np.testing.assert_array_equal(on_lanes(inside, a), [0.0, 1.0, 1.0, 0.0, 0.0])
        np.testing.assert_array_equal(on_lanes(outside, a), [1.0, 0.0, 0.0, 1.0, 0.0])


def root_or_minus_one(a):
    return where(a >= 0.0, sqrt(a), -1.0)


def inside(a):
    return where((a > -1.0) & (a < 1.0), 1.0, 0.0)


def outside(a):
    return where((a < -1.0) | (a > 1.0), 1.0, 0.0)


def test_lanes_and_numbers_on_a_tape_have_the_same_operations():
    """Check this because functions are tried on a tape before they are compiled for lanes."""
    inner = {"builder", "value", "_call", "_negated", "_with", "number", "tape", "_record"}
    number = taped(0.0, [])
    for ours, theirs in ((Lanes, number), (Mask, number < 1.0)):
        assert set(dir(ours)) - inner == set(dir(theirs)) - inner


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


def lanes_and_floats(pipeline, episodes, actions):
    epochs = len(episodes[0])
    return [
        track(pipeline, episodes, actions, epochs, KEPT, on_floats) for on_floats in (False, True)
    ]


def assert_same_tracks(a, b):
    """Check that beliefs agree to 1e-12 standard deviations, and derived results to 1e-9."""
    assert_same_beliefs(a, b, rtol=1e-12)
    assert_same_beliefs(*[{"x": t["x"], "P": t["P_predicted"]} for t in (a, b)], rtol=1e-12)
    for name in KEPT[3:]:
        np.testing.assert_allclose(a[name], b[name], rtol=1e-9, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(a["memory.accepted"], b["memory.accepted"])


@pytest.mark.parametrize("name", representative(OPTIONS, "default"))  # each compiles 3 programs
def test_filters_on_lanes_equal_filters_on_floats(name):
    """Run each filter alone, and with random switching between the filters."""
    actions = np.random.default_rng(0).integers(3, size=(60, 5))
    actions[:, :3] = range(3)
    pipeline = pipeline_of(algorithms=ALL, **OPTIONS[name])
    lanes, floats_ = lanes_and_floats(pipeline, simulated(5, epochs=60), actions)
    assert_same_tracks(lanes, floats_)
    if name == "recovery":
        assert lanes["memory.lockout"].max() > 2.0


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.slow
def test_odometry_on_lanes_equals_odometry_on_floats(planar):
    episodes = simulated(3, epochs=60, odometry=True)
    pipeline = pipeline_of(episodes[0].layout, ALL, planar)
    assert_same_tracks(*lanes_and_floats(pipeline, episodes, np.arange(3)))


@pytest.mark.slow
def test_lanes_equal_floats_for_a_user_at_rest_with_odometry():
    """Let users start at rest, where the heading is not defined."""
    episodes = [
        replace(episode, prior_mean=episode.prior_mean * [1, 1, 1, 0, 0, 0, 1])
        for episode in simulated(3, epochs=10, odometry=True)
    ]
    pipeline = pipeline_of(episodes[0].layout, ["ckf"])
    assert_same_tracks(*lanes_and_floats(pipeline, episodes, np.zeros(3, int)))


@pytest.mark.parametrize("n", [1, 3, 8, 13])
def test_results_do_not_depend_on_other_episodes_or_on_their_order(n):
    pipeline, episodes = pipeline_of(), simulated(13, epochs=60)
    actions = np.random.default_rng(1).integers(3, size=(60, 13))
    order = np.random.default_rng(n).permutation(13)[:n]
    everyone = track(pipeline, episodes, actions, 60, KEPT)
    some = track(pipeline, [episodes[i] for i in order], actions[:, order], 60, KEPT)
    for name in KEPT:
        np.testing.assert_array_equal(some[name], everyone[name][:, order], err_msg=name)


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="reads x86 assembly")
def test_the_stack_of_a_kernel_is_aligned(monkeypatch):
    monkeypatch.setattr(disk_cache, "_folder", lambda: None)  # kernels from disk have no assembly
    program = Program(lambda w: w._replace(x=[sum(w.x) * v for v in w.x]), Many([0.0], [1.0] * 60))
    program.on_lanes()
    code = program._compiled._library.get_asm_str()
    assert re.search(r"and[q]?\s+\$-64, %rsp", code)


@pytest.mark.parametrize("scenario", representative(MOBILITIES, "walk-ride"))
def test_a_world_on_lanes_equals_the_world_on_floats(scenario):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    episodes = source.sample_batch(np.arange(3, dtype=np.uint64))
    begun, world = source.begin(np.arange(3, dtype=np.uint64)), source.world
    settings = source.feed(begun.worlds).settings[:, 0]
    blank, (observed, happened, moved) = np.zeros(world.ends[0]), world.parts
    for kept, expected in zip(begun.worlds, episodes.table, strict=True):
        w = unflatten(world.template, iter(np.concatenate([blank, settings, kept]).tolist()))
        table = []
        for dt in source.steps_s:
            w = observed(w)
            for _ in range(int(w.settings.stride)):
                w = moved(happened(w))
            table.append(flatten(w.measured._replace(dt=dt)))
        np.testing.assert_allclose(table, expected, rtol=1e-9, atol=1e-9)
