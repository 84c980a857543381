"""Tests of the results of ``mmwave-loc speed``; tests/commands/test_speed.py runs the command."""

import numpy as np
import pytest

from experiments.timing.measured import (
    EPISODE,
    FILTERPY,
    FILTERS,
    STEP,
    compared,
    environments,
    filterpy_episode,
    kernels,
)
from experiments.timing.roofline import Operations, count
from mmwave_env.filters.filterpy_reference import filterpy_pipeline
from mmwave_env.numerics.numbers import atan2, maximum, sqrt, where
from mmwave_env.task import task_from
from tests.filters.tracks import sampled


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda a, b: a * b - 3.0, Operations(fused=1)),
        (lambda a, b: a * b + b * a, Operations(add=1, multiply=1)),  # b * a equals a * b
        (lambda a, b: a / b + 1.0 / b, Operations(add=1, divide=1, multiply=2)),  # both use 1 / b
        (lambda a, b: sqrt(a) - b, Operations(add=1, root=1)),
        (lambda a, b: where((a > b) & (a > 1.0), a, -b), Operations(select=5)),
        (lambda a, b: maximum(a, 2.0), Operations(select=1)),
        (lambda a, b: 1.0 * a + 0.0 * b, Operations()),
    ],
)
def test_the_operations_of_an_expression_are_counted(function, expected):
    counted = count(lambda w: [function(*w), w[1]], [0.0, 0.0])
    assert counted == expected


def test_operations_whose_result_is_not_used_are_not_counted():
    def function(w):
        atan2(w[0], w[1])
        return [w[0], w[1], w[2] + 1.0]

    assert count(function, [0.0] * 3) == Operations(add=1)


def test_the_filterpy_loop_earns_the_reward_of_a_good_track():
    task = task_from()
    episode = sampled(task.source)
    total = filterpy_episode(filterpy_pipeline(task.pipeline), episode)
    assert -5.0 < total / EPISODE < 0.0  # the worst reward of an epoch is -10.6


@pytest.fixture(scope="module")
def figures():
    """Return comparisons of three rounds of random numbers in place of measurements."""
    rng = np.random.default_rng(0)
    names = (*environments((8, 64, 1024)), *FILTERS)
    rates = {name: rng.uniform(1e3, 1e6, 3).tolist() for name in names}
    limits = {name: rng.uniform(1e-9, 1e-8, 3).tolist() for name in (STEP, *FILTERS)}
    return compared({"steps_per_s": rates, "limit_s": limits})


def test_ratios_are_computed_round_by_round(figures):
    rates = figures["steps_per_s"]
    ratio = np.divide(rates["native, N = 1024"], rates[FILTERPY])
    assert figures["ratios"]["native, N = 1024"] == pytest.approx(ratio)
    assert len(figures["ratios"]) == 7


@pytest.mark.parametrize(("name", "kernel"), [("UKF", "UKF"), ("native, N = 64, 1 thread", "step")])
def test_fractions_of_the_speed_limit_refer_to_the_kernel_that_runs(figures, name, kernel):
    expected = np.multiply(figures["limit_s"][kernel], figures["steps_per_s"][name])
    assert figures["limit_fraction"][name] == pytest.approx(expected)
    assert len(figures["limit_fraction"]) == 6


def test_a_step_needs_more_operations_than_each_of_its_filters():
    sums = {name: sum(operations) for name, operations in kernels().items()}
    assert sums["EKF"] < sums["UKF"] <= sums["CKF"] < sums["step"]
