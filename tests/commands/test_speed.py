"""Tests of ``mmwave-loc speed`` and of its results: operations, ratios, fractions of a limit."""

import re

import numpy as np
import pytest

from experiments.timing import measured
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
from tests.cli import assert_refused, succeed
from tests.filters.tracks import sampled
from tests.pages import blocks_of, made
from tests.paths import ROOT, json_in

PAGE = ROOT / "docs" / "performance.md"


@pytest.mark.slow
def test_a_short_run_prints_and_writes_all_results(tmp_path, monkeypatch):
    monkeypatch.setattr(measured, "EPOCHS", 60)
    monkeypatch.setattr(measured, "WARM_UP", 10)
    file = tmp_path / "new" / "all.json"
    options = ("--sizes", 8, "--seconds", 0, "--repeats", 1)
    shown = succeed("speed", *options, "--json", file)
    titles = re.findall("^### (.*)", shown, re.MULTILINE)
    assert titles == ["Ratios", "Steps per second", "Limit of the core", "Latency"]
    result = json_in(file)
    assert result["command"] == "mmwave-loc speed --sizes 8 --seconds 0.0 --repeats 1"
    assert {"EKF", "UKF", "CKF", "native, N = 8, 1 thread"} <= set(result["limit_fraction"])
    for block in blocks_of(PAGE):
        for table in block.tables:
            assert made(table, shown, tmp_path).splitlines()[:2] == table["shown"].splitlines()[:2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--sizes", "8", "0"], r"sizes: found \[8, 0\], expected numbers of at least 1"),
        (["--seconds", "-1"], "seconds: found -1.0, expected a time of at least 0"),
        (["--repeats", "0"], "repeats: found 0, expected at least 1"),
    ],
)
def test_mistakes_end_with_one_clear_line_before_anything_is_timed(options, message):
    assert_refused(f"^mmwave-loc speed: .*{message}", "speed", *options)


# --- the results


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
