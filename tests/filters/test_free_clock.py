"""Tests of a user's clock that every epoch draws anew, so that only differences of ranges count."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import block_diag

from mmwave_env.engines.engine import run_imm
from mmwave_env.filters import textbook
from mmwave_env.filters.bank import Bank, modes_from
from mmwave_env.filters.memory import initial_memory
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Epoch, Site
from mmwave_env.numerics.linalg import pack, unpack
from mmwave_env.world.keys import keys_of
from tests.filters.tracks import (
    HZ_PER_MPS,
    assert_same_beliefs,
    sampled,
    street_source,
    track,
    wrapped,
)

STATE = np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0])
LIMIT = 6.6349  # 99 % quantile of chi-square with one degree of freedom


class Problem(NamedTuple):
    """A prior, and an epoch whose ranges all contain the same unknown bias."""

    sensor: textbook.Sensor
    x: np.ndarray  # (7,)
    P: np.ndarray  # (7, 7)
    z: np.ndarray
    sigma: np.ndarray
    measured: np.ndarray

    def with_bias(self, bias):
        """Return the problem with another bias in all ranges."""
        z = self.z.copy()
        z[0:-1:4] += bias
        return self._replace(z=z)

    def ours(self):
        links = self.sensor.links
        layout = Layout(links, partial=True, clock="free")
        mode = Mode("ekf", "ekf", gate=None, **dict.fromkeys(NOISES, 0.0))
        visible = np.logical_or.reduceat(self.measured, layout.starts)
        doppler_of = [float(a == self.sensor.shifted) for a in range(links)]
        epoch = Epoch(0.0, self.z.tolist(), self.sigma.tolist(), visible.astype(float).tolist(),
                      [30.0] * links, 0.0, self.measured.astype(float).tolist(),
                      doppler_of)  # fmt: skip
        x = [*self.x, 3.0]
        P = pack(block_diag(self.P, 1.0).tolist())
        site = Site(self.sensor.anchors.tolist(), HZ_PER_MPS, x, P)
        memory = initial_memory(layout, 1)
        return predict_update(Pipeline((mode,), layout), mode, x, P, memory, epoch, site)

    def disagreements(self):
        """Return T (L, L) of each pair of ranges."""
        d = self.x[:3] - self.sensor.anchors
        distance = np.linalg.norm(d, axis=1)
        y = self.z[0:-1:4] - distance
        u = d / distance[:, None]
        g = u[:, None] - u
        S = np.einsum("lmi,ij,lmj->lm", g, self.P[:3, :3], g)
        R = self.sigma[0:-1:4] ** 2
        return (y[:, None] - y) ** 2 / (S + R[:, None] + R)


NOISES = ("sigma_p", "sigma_v", "sigma_pz", "sigma_vz", "sigma_b_mps", "spread_gain")


def masts(rng, count):
    """Return random anchors (count, 3) around the user."""
    return np.column_stack([rng.uniform(-60, 60, (count, 2)), rng.uniform(4, 12, count)])


@st.composite
def problems(draw, wild=0):
    """Draw a problem with three or more right ranges; ``wild`` other ranges are too long."""
    links = draw(st.integers(3, 6)) + wild
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    sensor = textbook.Sensor(masts(rng, links), HZ_PER_MPS, shifted=int(rng.integers(links)))
    root = np.tril(rng.normal(0, 0.2, (7, 7)), -1) + np.diag(rng.uniform(0.3, 2.0, 7))
    x = np.array([0.0, 0.0, 1.5, *rng.normal(0, 1, 3), 5.0])
    truth = x + 0.4 * root @ rng.standard_normal(7)
    sigma = np.append(np.tile([0.4, 0.05, 0.05, 0.05], links), 3.0)
    z = sensor.h(truth) + sigma * rng.normal(0, 0.5, len(sigma))
    z[0 : 4 * wild : 4] += rng.uniform(60.0, 300.0, wild)
    z[sensor.angles] = wrapped(z[sensor.angles])
    measured = rng.random(len(z)) < 0.7
    measured[0:-1:4] = True
    return Problem(sensor, x, root @ root.T, z, sigma, measured)


def update_with_differences(model, x, P, z, R, keep, reference):
    """Condition x (7,) on differences of ranges (TDoA) and on all rows that are not ranges.

    All ranges contain the same unknown bias, which cancels in their differences to the range of
    the anchor ``reference``; the noise of this range correlates them. Other arguments are the same
    as for :func:`mmwave_env.filters.textbook.update`.
    """
    D = np.eye(len(z))
    D[0 : 4 * model.links : 4, 4 * reference] -= 1.0
    D = D[keep & (np.arange(len(z)) != 4 * reference)]
    H = model.jacobian(x)
    S = D @ (H @ P @ H.T + np.diag(R)) @ D.T
    K = np.linalg.solve(S, D @ H @ P).T
    y = model.residual(z, model.h(x), x)
    return x + K @ D @ y, P - K @ S @ K.T


@given(problem=problems(), bias=st.floats(-5e3, 5e3), data=st.data())
@settings(max_examples=60)
def test_without_doubtful_ranges_the_update_is_that_of_their_differences(problem, bias, data):
    assume(problem.disagreements().max() < LIMIT)
    reference = data.draw(st.integers(0, problem.sensor.links - 1))
    expected_x, expected_P = update_with_differences(
        problem.sensor, problem.x, problem.P, problem.z, problem.sigma**2, problem.measured,
        reference,
    )  # fmt: skip
    biased = problem.with_bias(bias)
    result = biased.ours()
    P = np.array(unpack(result.P))
    assert_allclose(result.x[:7], expected_x, rtol=1e-5, atol=1e-5)
    assert_allclose(P[:7, :7], expected_P, rtol=1e-5, atol=1e-5)
    # The bias: ranges minus the distances to the updated position, as a flat prior gives them.
    flat = block_diag(problem.P, 1e7)
    sensor = textbook.Sensor(
        problem.sensor.anchors, HZ_PER_MPS, shifted=problem.sensor.shifted, clock=True
    )
    whole_x, whole_P = textbook.update(
        textbook.tangent, sensor, np.append(problem.x, 0.0), flat, biased.z, problem.sigma**2,
        problem.measured,
    )  # fmt: skip
    assert result.x[7] == pytest.approx(whole_x[7], rel=1e-4, abs=0.01)
    assert_allclose(P, whole_P, rtol=1e-3, atol=1e-3)


@given(problem=problems(wild=1))
@settings(max_examples=40)
def test_a_wild_range_is_doubted_and_costs_likelihood_and_the_others_decide(problem):
    T = problem.disagreements()
    assume(T[1:, 1:].max() < 0.5 * LIMIT and T[0, 1:].min() > 20.0 * LIMIT)
    result = problem.ours()
    assert result.accepted[0] == 0.0
    assert min(result.accepted[1 : problem.sensor.links]) == 1.0
    assert result.nis[0] > 20.0 * LIMIT
    measured = problem.measured.copy()
    measured[0] = False
    known = problem._replace(measured=measured).ours()
    deviation = np.sqrt(np.diag(unpack(known.P)))
    assert np.all(np.abs(np.array(result.x) - known.x)[:7] < 0.1 * deviation[:7])
    assert result.log_likelihood < known.log_likelihood - 9.0 * LIMIT


def test_the_likelihood_of_many_wild_ranges_is_finite():
    """Let 30 ranges be up to 1000 km off: the largest that a log may have."""
    rng = np.random.default_rng(0)
    sensor = textbook.Sensor(masts(rng, 32), HZ_PER_MPS)
    z = sensor.h(STATE)
    z[8:-1:4] += rng.choice([-1, 1], 30) * rng.uniform(1e5, 1e6, 30)
    measured = np.zeros(len(z), bool)
    measured[0:-1:4] = True
    result = Problem(sensor, STATE, 1e-4 * np.eye(7), z, np.full(len(z), 0.01), measured).ours()
    assert np.isfinite([*result.x, *result.P, *result.nis, result.log_likelihood]).all()
    assert_allclose(result.x[:3], STATE[:3], atol=0.05)


def test_a_range_alone_only_sets_the_clock_and_does_not_end_a_lockout():
    sensor = textbook.Sensor(np.array([[40.0, 5.0, 8.0]]), HZ_PER_MPS)
    z = sensor.h(STATE)
    measured = np.array([True, False, False, False, False])
    result = Problem(sensor, STATE, np.eye(7), z, np.full(5, 0.3), measured).with_bias(700.0).ours()
    assert_allclose(result.x[:7], STATE)
    assert result.x[7] == pytest.approx(700.0)
    assert result.passed == 0.0
    assert result.nis[0] == 1.0


@pytest.mark.slow  # runs many episodes
def test_position_errors_agree_with_their_covariance():
    source = street_source(radio="standard", epochs=100, clock="free")
    bank = Bank(modes_from(None, "standard"))
    episodes = source.sample_batch(keys_of(range(100, 160)))
    run = run_imm(bank, TrackingReward(), episodes, "nees")
    late = run["nees"][:, 20:]
    assert np.isfinite(late).all()
    assert np.median(late) < 1.4 * 2.37  # chi2(3).median(); the tuned bank has about 2.9


@pytest.mark.parametrize("clock", ["synchronized", "free"])
def test_errors_that_last_longer_than_a_step_get_more_noise(clock):
    """Compare 0.3 s of correlation at steps of 0.1 s with noise that is larger by sqrt(3)."""
    source = street_source(radio="standard", epochs=20, dt=0.1, clock=clock)
    episode = sampled(source, 3)
    louder = replace(
        episode, sigma=episode.sigma * np.where(np.arange(20) > 0, 3**0.5, 1.0)[:, None]
    )
    mode = replace(modes_from(["ekf"], "standard")[0], gate=None, adaptive=False)
    pipeline = Pipeline((mode,), source.layout)
    correlated = replace(pipeline, correlation_s=0.3)
    tracks = [
        track(p, [e], 0, 20, ("x", "P")) for p, e in ((correlated, episode), (pipeline, louder))
    ]
    assert_same_beliefs(*tracks, rtol=1e-9)
