"""Tests of protection levels: bounds that errors exceed with a stated probability, the risk."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.contenders import contender_from
from experiments.evaluation.positions import Positions
from experiments.evaluation.runner import score_contenders
from mmwave_env.localization.levels import PARTS, Levels, Network
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.position_errors import PositionErrors, error_sizes, gaussian_levels
from mmwave_env.localization.tracker import Tracker
from mmwave_env.task import task_from
from policies import load
from tests.localization.test_policy_tracks import (  # noqa: F401
    RADIO,
    ROWS,
    SCENE,
    corrector,
    first_epochs,
)
from tests.localization.test_position_errors import covariances
from tests.paths import representative
from tests.refusals import refuses

N = 3
T = 40
ANCHORS = 3
FRESH = 5_900_000  # first tuning seed that was not used to calibrate levels
every_risk = pytest.mark.parametrize("risk", [0.01, 0.001])


def parts():
    """Return random results: x, P, NIS, accepted, rejected, and trust in corrections (0 to 1)."""
    rng = np.random.default_rng(0)
    # 0: the gate accepted the group; 1: the gate rejected it; 2: the group was not visible
    fate = rng.integers(3, size=(N, T, ANCHORS + 1))
    nis = rng.chisquare(4, fate.shape)
    x = rng.normal(size=(N, T, 7))
    P = covariances(N, T)
    trusted = rng.random((N, T))
    return named(x, P, nis, fate == 0, fate == 1, trusted)


def named(*parts):
    return dict(zip((*PARTS, "trusted"), parts, strict=True))


def test_a_risk_that_no_calibration_covers_and_an_unknown_kind_are_refused():
    with pytest.raises(ValueError, match="risk: found 0.05, expected 0.01 or 0.001"):
        Levels(0.05)
    with refuses("levels"):
        Levels(kind="exact")
    factors = Levels(0.05, "gaussian").factors(ANCHORS, True, np.arange(T), parts())
    assert_array_equal(factors, np.ones((N, T, 2)))


@every_risk
def test_factors_are_positive_and_finite_for_any_outputs_of_a_filter(risk):
    x, P, nis, accepted, rejected, trusted = parts().values()
    levels = Levels(risk)
    for extreme in (
        [x, 1e-12 * P, nis, accepted, rejected, trusted],
        [1e3 * x, 1e8 * P, 1e9 * nis, accepted & False, rejected, None],
        [0.0 * x, P, nis, accepted & False, rejected & False, np.nan * trusted],
        [x, 0.0 * P, np.inf * (1.0 + nis), accepted, rejected, trusted],
    ):
        levels.reset()
        with np.errstate(invalid="ignore"):
            factors = levels.factors(ANCHORS, True, 0.1 * np.arange(T), named(*extreme))
        assert factors.shape == (N, T, 2) and np.isfinite(factors).all() and (factors > 0.0).all()


@pytest.mark.parametrize(
    "name", representative(["corrector", "guided", "ppo-standard"], "ppo-standard")
)
def test_a_live_track_and_its_levels_equal_those_of_the_log(corrector, name):  # noqa: F811
    switching = load(corrector if name == "corrector" else name, "standard")
    track = localize(first_epochs(), SCENE, RADIO, switching, window=None, levels=Levels())
    tracker = Tracker(SCENE, switching, "standard", levels=Levels())
    live = [tracker.update(epoch) for epoch in ROWS]
    assert_array_equal([[*p.position_m, *p.velocity_mps] for p in live], track.x[:, :6])
    if name == "corrector":
        assert_array_equal([p.trusted for p in live], track.trusted)
    expected = gaussian_levels(track.P, 1e-3) * track.level_factors
    assert_allclose([p.levels_m for p in live], expected, rtol=1e-6)
    assert Tracker(SCENE, switching, "standard").update(ROWS[0]).levels_m is None


def test_gaussian_levels_follow_from_the_covariances():
    task = task_from(radio="handset", episode_steps=30)
    plain = PositionErrors(0.05)
    positions = Positions(Levels(0.05, "gaussian"), 3, planar=False)

    def add(contender, time_s, results):
        plain.add(results["error"][:, 10:], results["P"][:, 10:])

    watch = [positions.add, add]
    seeds = range(FRESH, FRESH + 8)
    imm = contender_from("imm", "handset")
    score_contenders([imm], task.source, seeds, watch=watch, after=PARTS)
    expected = {"risk": 0.05, "levels": "gaussian", "policies": {"imm": plain.figures()}}
    assert positions.figures() == expected


@pytest.mark.slow
@pytest.mark.parametrize("pair", ["street:handset", "o1:standard", "dynamic-doppler:high"])
@every_risk
def test_errors_exceed_levels_at_most_as_often_as_stated(pair, risk):
    """Fail only if 300 episodes show with 99.9 % confidence that errors exceed levels too often."""
    scene, radio = pair.split(":")
    levels = Levels(risk)
    shares = {}  # of epochs whose errors exceed their levels, (episodes, [horizontal, vertical])

    def keep(contender, time_s, results):
        levels.reset()
        factors = levels.factors(ANCHORS, contender.bank is not None, time_s, results)
        bounds = gaussian_levels(results["P"], risk) * factors
        shares[contender.name] = (error_sizes(results["error"]) > bounds).mean(axis=1)

    source = task_from(scene=scene, radio=radio).source
    seeds = range(FRESH, FRESH + 300)
    chosen = [contender_from(name, radio) for name in ("guided", "corrector", "imm-best")]
    score_contenders(chosen, source, seeds, watch=[keep], after=PARTS)
    assert len(shares) == 3
    for name, share in shares.items():
        deviation = share.std(axis=0) / np.sqrt(len(share))
        assert (share.mean(axis=0) - 3.1 * deviation <= risk).all(), name


@pytest.mark.slow
@pytest.mark.torch
@pytest.mark.filterwarnings("ignore:speed above")
def test_levels_are_infinite_for_a_risk_that_is_too_small_for_the_calibration(tmp_path):
    pytest.importorskip("torch")
    from experiments.training.levels import RISKS, trained_levels

    network = trained_levels(5_000_000, rounds=1, calibration=1, steps=200)
    path = tmp_path / "levels.safetensors"
    path.write_bytes(network.to_bytes("mmwave-loc tune --levels"))
    read = Network.read(path)
    assert_array_equal(read.tensors["constants"], network.tensors["constants"])
    features = Levels(kind="gaussian").features(ANCHORS, True, np.arange(T), parts())
    factors = read.log_factors(features)
    assert factors.shape == (N, T, len(RISKS), 2)
    assert np.isfinite(factors[..., 0, :]).all() and np.isposinf(factors[..., 1, :]).all()
