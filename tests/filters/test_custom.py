"""Tests that algorithms unable to run on SIMD lanes are refused early, with good advice."""

import importlib.util
import linecache
import math
from functools import partial

import gymnasium as gym
import pytest

from mmwave_env.filters import Mode, Pipeline, Posterior, SigmaPoints, ckf, ekf, ukf, update
from mmwave_env.filters.custom import AlgorithmError
from mmwave_env.models.layout import Layout
from tests.filters.tracks import STREET

BEFORE = """import math
from math import sqrt
import numpy as np
from mmwave_env.numerics.numbers import where
from mmwave_env.filters import ekf
TABLE = [1.0, 2.0]
def mine(x, P, measurement, gate):
    a, b = x[0], P[0][0]
"""
AFTER = "\n    return ekf(x, P, measurement, gate)\n"
LINE = BEFORE.count("\n") + 1
BRANCH = "a branch needs the value of a number that stands for 8 environments: write where("
EQUAL = "a comparison by == or != needs the value of a number"
REFUSED = {
    "if a > 0.0: b = a": BRANCH,
    "c = where(a > 0.0 and b > 0.0, 1.0, 0.0)": BRANCH,
    "c = max(a, b)": BRANCH,
    "c = np.where(a > 0.0, a, b)": BRANCH,
    "c = a == b": EQUAL,
    "c = a in TABLE": EQUAL,
    "c = math.sqrt(b)": "must be real number, not Tracer",
    "c = TABLE[a]": "list indices must be integers",
    "c = np.sqrt(b)": "operand 'Tracer' does not support ufuncs",
    "c = np.linalg.inv(P)": "ufunc 'inv'",
    "c = b ** 0.5": "unsupported operand type(s) for **",
    "c = {a: 1.0}": "unhashable type",
    "c = (a > 0.0) * 2.0": "unsupported operand type(s) for *: 'TracerCondition'",
    "c = a * (a > 0.0)": "unsupported operand type(s) for *: 'Tracer' and 'TracerCondition'",
    "c = (a > 0.0) < a": "not supported between instances of 'TracerCondition'",
    "c = where(b, 1.0, 0.0)": "'Tracer' object has no attribute 'select'",
    "c = where(~(a > 0.0), 1.0, 0.0)": "bad operand type for unary ~",
}


@pytest.fixture
def written(tmp_path):
    """Return a function that writes an algorithm with one chosen line of code, and imports it."""

    def write(line):
        file = tmp_path / "filters.py"
        file.write_text(f"{BEFORE}    {line}{AFTER}")
        linecache.checkcache(str(file))
        spec = importlib.util.spec_from_file_location("filters", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return file, module.mine

    return write


def refusal(algorithm, layout=STREET, **options):
    with pytest.raises(AlgorithmError) as error:
        Pipeline((Mode("own", algorithm, **options),), layout)
    return error.value


@pytest.mark.parametrize(("line", "reason"), REFUSED.items(), ids=REFUSED)
def test_code_that_lanes_cannot_run_is_refused_with_line_and_reason(written, line, reason):
    file, algorithm = written(line)
    head, where, text, shown, advice = str(refusal(algorithm)).splitlines()
    assert "mine of mode 'own'" in head and text.strip() == line
    assert where.startswith(f'  File "{file}", line {LINE}, in ')
    assert reason in shown
    assert "the functions of mmwave_env.numerics.numbers" in advice


def helper(a):
    return max(a, 0.0)  # refused here


def helped(x, P, measurement, gate):
    helper(x[0])
    return ekf(x, P, measurement, gate)


def wrapped(x, P, measurement, gate):
    helped(x, P, measurement, gate)
    return update(x, P, measurement, gate, SigmaPoints())


class Filter:
    def __call__(self, x, P, measurement, gate):
        helper(x[0])
        return ekf(x, P, measurement, gate)


@pytest.mark.parametrize("algorithm", [helped, wrapped, partial(helped), Filter()])
def test_the_message_shows_the_innermost_line_of_the_custom_code(algorithm):
    number = 1 + next(
        i for i, line in enumerate(linecache.getlines(__file__)) if "# refused here" in line
    )
    message = str(refusal(algorithm))
    assert f'File "{__file__}", line {number}, in helper' in message
    assert "maximum(a, b)" in message


def changed(**fields):
    """Return an EKF that applies the given functions to fields of its posterior."""

    def algorithm(x, P, measurement, gate):
        after = ekf(x, P, measurement, gate)
        return after._replace(**{name: f(getattr(after, name)) for name, f in fields.items()})

    return algorithm


def nothing(x, P, measurement, gate):
    ekf(x, P, measurement, gate)


def too_few(x, P, gate):
    return ekf(x, P, None, gate)


RETURNS = {
    nothing: "returned None",
    changed(x=tuple): "returned x: tuple of 7",
    changed(P=lambda P: [*P[:6], P[6][:2]]): "returned P[6]: list of 2",
    changed(
        accepted=lambda accepted: [a > 0.5 for a in accepted]
    ): "returned accepted[0]: a condition",
    changed(log_likelihood=lambda value: math.nan): "returned log_likelihood nan",
    too_few: "takes 3 positional arguments",
}


@pytest.mark.parametrize(("algorithm", "problem"), RETURNS.items(), ids=RETURNS.values())
def test_wrong_results_and_signatures_are_refused(algorithm, problem):
    message = str(refusal(algorithm))
    assert message.startswith(f"algorithm {algorithm.__name__} of mode 'own' ")
    assert problem in message
    code = algorithm.__code__
    assert f'File "{code.co_filename}", line {code.co_firstlineno}, in' in message


def widens_the_prior(x, P, measurement, gate):
    P[0][0] = P[0][0] + 1.0
    return ekf(x, P, measurement, gate)


def test_an_algorithm_that_changes_its_arguments_is_refused():
    assert "changed its argument P" in str(refusal(widens_the_prior))


def test_making_an_environment_with_an_algorithm_that_cannot_run_is_refused(written):
    file, algorithm = written("c = max(a, b)")
    for make in (gym.make, partial(gym.make_vec, num_envs=2)):
        with pytest.raises(TypeError) as error:
            make("MmWaveLoc-v0", modes=["ekf", Mode("own", algorithm)])
        assert f'File "{file}", line {LINE}, in mine' in str(error.value)


@pytest.mark.parametrize("layout", [Layout(1), Layout(9, True), Layout(3, partial=True)], ids=str)
@pytest.mark.parametrize("planar", [False, True], ids=["hilly", "planar"])
@pytest.mark.parametrize("ours", [ekf, ukf, ckf])
@pytest.mark.parametrize("options", [{}, {"robust": True}, {"gate": None, "recovery": None}])
def test_valid_algorithms_are_accepted_with_any_layout(layout, planar, ours, options):
    """Check an algorithm with an ``if`` on layout and gate, which are known before it runs."""

    def own(x, P, measurement, gate):
        if measurement.layout.odometry and gate.robust and gate.quantile is not None:
            return ekf(x, P, measurement, gate)
        return ours(x, P, measurement, gate)

    Pipeline((Mode("own", own, **options),), layout, planar)


def fuses_nothing(x, P, measurement, gate):
    groups = [0.0] * len(measurement.layout.groups)
    return Posterior(list(x), [list(row) for row in P], groups, groups, 0.0)


def nearly_constant_likelihood(x, P, measurement, gate):
    posterior = fuses_nothing(x, P, measurement, gate)
    likelihood = ekf(x, P, measurement, gate).log_likelihood
    return posterior._replace(log_likelihood=30.0 + 1e-9 * likelihood)


@pytest.mark.parametrize(
    "algorithm",
    [
        fuses_nothing,
        changed(log_likelihood=lambda value: -3.0),
        nearly_constant_likelihood,
        changed(log_likelihood=lambda value: 1e6 + value),
    ],
    ids=["fuses nothing", "constant", "nearly constant", "enormous"],
)
@pytest.mark.parametrize(
    "layout", [STREET, Layout(1), Layout(2, partial=True), Layout(3, odometry=True, clock="offset")]
)
def test_a_likelihood_that_does_not_fall_with_the_innovation_is_refused(algorithm, layout):
    """Check this because an IMM trusted a mode that fused nothing with 61 % of its probability."""
    assert "log_likelihood" in str(refusal(algorithm, layout))
