"""Tests of rivals of the shipped filters, in ``examples``."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from examples.rivals import (
    EVERYTHING,
    Particles,
    StudentImm,
    Variational,
    adapted,
    resampled,
    stated,
    student_t,
)
from examples.safe_imm import SafeImm
from experiments.evaluation.agents import Estimator
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.runner import Scoring, run_contender
from mmwave_env.engines.engine import run_imm
from mmwave_env.filters import Mode, Pipeline, ekf, ukf
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import exact_rows
from mmwave_env.models.radio import RADIOS
from mmwave_env.numerics.linalg import unpack
from tests.filters.tracks import street_source
from tests.refusals import refuses

PLAIN = Mode("plain", "ekf", sigma_v=1.0, sigma_vz=0.5, gate=None, adaptive=False)
SOURCE = street_source(epochs=20)
MANY = 1e9  # degrees of freedom that make Student-t noise Gaussian


def episodes(n, source=SOURCE):
    return source.episodes(np.arange(n, dtype=np.uint64))


def played(agent, some, planar=False):
    contender = Contender.own("own", agent, "handset", [PLAIN])
    return run_contender(contender, some, Scoring(planar=planar), after=("x", "P"))


class Recorder(Estimator):
    """An estimator that stores its inputs and returns the prior in every epoch.

    Its means are cut to ``size`` numbers; after ``epochs`` epochs, it returns no more beliefs.
    """

    def __init__(self, size=7, epochs=None):
        self.size = size
        self.epochs = epochs

    def track(self, pipeline, site, epochs):
        self.site = site
        self.drawn = list(epochs)
        for _ in self.drawn[: self.epochs]:
            yield site.prior_x[: self.size], site.prior_P


def priors_and_measurements():
    """Yield (x, P, measurement) for every fifth epoch of three episodes; x and P are the prior."""
    for episode in episodes(3):
        agent = Recorder()
        played(agent, [episode])
        for epoch in agent.drawn[::5]:
            P = unpack(agent.site.prior_P)
            yield agent.site.prior_x, P, stated(epoch, agent.site, episode.layout)


def test_particles_agree_with_the_ekf_in_a_nearly_linear_problem():
    """Use large noise, so that many particles have similar weights and their mean is accurate."""
    good = replace(SOURCE, radio=RADIOS["standard"])
    some = [replace(episode, sigma=4.0 * episode.sigma) for episode in episodes(4, good)]
    cloud = played(Particles(dof=MANY), some)
    kalman = played(lambda rows: np.zeros(len(rows), int), some)
    # Leave out the EKF's oscillator bias, which the nonlinear Doppler shift distorts.
    diagonal = [i * (i + 1) // 2 + i for i in range(6)]
    deviation = np.sqrt(kalman["P"][..., diagonal])
    away = np.abs(cloud["x"] - kalman["x"])[..., :6] / deviation
    assert away.mean(axis=(0, 1)).max() < 0.15
    ratio = np.sqrt(cloud["P"][..., diagonal]) / deviation
    assert_allclose(ratio.mean(axis=(0, 1)), 1.0, atol=0.08)


def test_resampling_is_in_proportion_to_the_weights():
    share = np.array([0.5, 0.0, 0.25, 0.125, 0.125, 0.0, 0.0, 0.0])
    drawn = resampled(share, np.random.default_rng(0))
    assert np.bincount(drawn, minlength=8).tolist() == [4, 0, 2, 1, 1, 0, 0, 0]


@pytest.mark.parametrize("base", [ekf, ukf])
def test_student_t_noise_with_many_degrees_of_freedom_is_gaussian(base):
    for prior in priors_and_measurements():
        ours = student_t(*prior, EVERYTHING, base=base, dof=MANY)
        theirs = base(*prior, EVERYTHING)
        for part, expected in zip(ours, theirs, strict=True):
            assert_allclose(part, expected, rtol=1e-6, atol=1e-6)


def test_an_outlier_hardly_moves_a_belief_with_student_t_noise():
    x, P, measurement = next(priors_and_measurements())
    false = measurement._replace(z=[measurement.z[0] + 200.0, *measurement.z[1:]])

    def moved(update):
        shifted = update(x, P, false, EVERYTHING).x[:3]
        expected = update(x, P, measurement, EVERYTHING).x[:3]
        return np.linalg.norm(np.subtract(shifted, expected))

    assert moved(student_t) < 0.1 * moved(ekf)


@pytest.mark.slow
def test_adaptive_noise_converges_to_the_true_noise():
    """State half the true standard deviations, so the estimated factor on variances should be 4."""
    x, _, measurement = next(priors_and_measurements())
    layout = measurement.layout
    rng = np.random.default_rng(0)
    P = (1e-6 * np.eye(7)).tolist()
    exact = exact_rows(x[:3], x[3:6], measurement.anchors, measurement.hz_per_mps, layout)
    exact[layout.doppler] += x[6]
    exact = np.array(exact)
    shape = [50.0] * len(layout.groups)
    rate = shape
    for _ in range(1000):
        z = exact + 2.0 * np.sqrt(measurement.variance) * rng.standard_normal(layout.size)
        shape = [0.99 * value for value in shape]
        rate = [0.99 * value for value in rate]
        everywhere = measurement._replace(z=z.tolist(), visible=[1.0] * len(layout.groups))
        *_, shape, rate = adapted(x, P, everywhere, shape, rate, ekf)
    # The factor 0.99 gives a memory of about 100 epochs, so estimates rest on few values: 400 for a
    # link, 100 for the Doppler shift.
    assert_allclose(np.divide(rate, shape), 4.0, rtol=0.3)


def test_safe_imm_is_the_imm_unless_the_most_probable_mode_is_near_its_mean():
    some = episodes(20)
    modes = default_modes("handset")
    imm = run_imm(Bank(modes), None, some, "x", "mixture", "mixture.probability")

    def positions(**limits):
        contender = Contender.own("own", SafeImm(**limits), "handset", list(modes))
        return run_contender(contender, some, after=("x",))["x"][..., :2]

    mean = imm["x"][..., :2]
    assert_allclose(positions(probable=2.0), mean, atol=1e-9)
    reported = positions(probable=0.8, near=np.inf)
    first = imm["mixture.probability"][..., 0] >= 0.8
    assert 0.1 < first.mean() < 0.9
    assert_allclose(reported[first], imm["mixture"][..., :2][first], atol=1e-9)
    bounded = positions(probable=0.8, near=0.01)
    assert abs(bounded - mean).max() < abs(reported - mean).max()


def test_beliefs_of_a_wrong_size_and_missing_epochs_are_refused():
    for agent in (Recorder(size=6), Recorder(epochs=3)):
        with refuses("beliefs of Recorder"):
            played(agent, episodes(2))


@pytest.mark.parametrize(
    "options", [{}, {"clock": "offset"}, {"measurements": ("range", "azimuth")}], ids=str
)
@pytest.mark.parametrize("agent", [Particles(500), Variational()], ids=lambda a: type(a).__name__)
def test_rivals_track_with_any_receiver_and_on_flat_ground(agent, options):
    some = episodes(2, replace(SOURCE, **options))
    for planar in (False, True):
        results = played(agent, some, planar)
        assert np.linalg.norm(results["error"], axis=-1).mean() < 10.0
        assert np.isfinite(results["nees"]).all()


def test_a_rival_can_be_named_as_a_contender():
    contender = contender_from("examples.rivals:variational", "handset")
    results = run_contender(contender, episodes(2))
    assert results["reward"].shape == (2, SOURCE.epochs)
    Pipeline(StudentImm().bank("handset").modes, Layout())  # raises if SIMD lanes can't run it


def test_an_estimator_is_refused_as_a_policy_that_chooses_modes():
    with refuses("policy"):
        Variational().act(np.zeros((1, 3), np.float32))
    contender = Contender.own("own", Variational(), "handset")
    with refuses("policy"):
        run_contender(contender, episodes(2), after=("memory.nis",))
