"""What happens around stops and pull-aways, against means written out."""

import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.decisions import Decisions
from experiments.evaluation.events import fast_pull_aways, fast_stops
from experiments.evaluation.runner import run_contender
from experiments.evaluation.seeds import draw_episodes
from experiments.figures.events import draw_decisions
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource
from tests.training.actors import HANDSET

N, T = 12, 60
SOURCE = SimulatedSource(SCENES["street"], RADIOS["handset"], "vehicle", epochs=T)
NAMES = ("speed-rule", "imm", "fixed-ukf", "likelihood-rule")


@pytest.fixture(scope="module")
def episodes():
    """Their users stand and drive as no user would, and often."""
    rng, heading = np.random.default_rng(1), [0.6, 0.8, 0.0]
    return [
        replace(e, truth_velocity_mps=np.outer(rng.choice([0.1, 4.0], T // 4).repeat(4), heading))
        for e in draw_episodes(SOURCE, range(N))
    ]


@pytest.fixture(scope="module")
def told():
    rng = np.random.default_rng(2)
    return {
        name: {"error": rng.normal(size=(N, T, 3)), "mode": rng.integers(2, size=(N, T))}
        for name in NAMES
    } | {"imm": {"error": rng.normal(size=(N, T, 3))}}


def collected(episodes, told, *parts):
    """Decisions of all contenders, told in parts."""
    decisions = Decisions({name: name for name in NAMES if name != "likelihood-rule"})
    for part in parts or (slice(None),):
        for name, table in told.items():
            some = {key: values[part] for key, values in table.items()}
            decisions.add(contender_from(name, "handset"), episodes[part], some)
    return decisions


def test_numbers_are_means_over_events(episodes, told):
    content = collected(episodes, told).json
    assert content["time_s"] == list(range(-10, 21))
    speed = np.stack([np.linalg.norm(episode.truth_velocity_mps, axis=1) for episode in episodes])
    for kind, find in (("stop", fast_stops), ("pull-away", fast_pull_aways)):
        events, row = np.argwhere(find(speed, 1.0)), content[kind]
        assert row["events"] == len(events) > 10
        assert list(row["error_m"]) == ["speed-rule", "imm", "fixed-ukf"]
        for i, offset in enumerate(range(-10, 21)):
            there = [(e, t + offset) for e, t in events if BURN_IN <= t + offset < T]
            for name, errors in row["error_m"].items():
                expected = np.mean([np.linalg.norm(told[name]["error"][at]) for at in there])
                assert errors[i] == pytest.approx(expected)
            share = np.mean([told["speed-rule"]["mode"][at] for at in there])
            shares = row["share"]["speed-rule"]
            assert (shares["ekf"][i], shares["ukf"][i]) == pytest.approx((1.0 - share, share))
        assert list(row["share"]) == ["speed-rule"]  # the others decide nothing


def test_differences_are_of_the_same_events_and_from_the_rule(episodes, told):
    for kind in ("stop", "pull-away"):
        row = collected(episodes, told).json[kind]
        assert row["minus"] == "speed-rule" and list(row["error_minus_m"]) == ["imm", "fixed-ukf"]
        for name, band in row["error_minus_m"].items():
            errors = (np.array(row["error_m"][of], float) for of in (name, "speed-rule"))
            assert band["mean"] == pytest.approx(np.subtract(*errors), nan_ok=True)
            assert (np.array(band["low"]) <= band["mean"]).all()
            assert (np.array(band["mean"]) <= band["high"]).all()


def test_parts_add_up_to_the_whole(episodes, told):
    whole = collected(episodes, told).json
    parts = collected(episodes, told, slice(0, 5), slice(5, 6), slice(6, N)).json
    assert parts["stop"]["events"] == whole["stop"]["events"]
    for kind in ("stop", "pull-away"):
        for name, errors in whole[kind]["error_m"].items():
            assert parts[kind]["error_m"][name] == pytest.approx(errors)
        assert parts[kind]["share"]["speed-rule"]["ukf"] == pytest.approx(
            whole[kind]["share"]["speed-rule"]["ukf"]
        )


def test_contenders_have_the_name_they_are_shown_with(episodes, told):
    decisions = Decisions({"speed-rule": "fixed-a", "imm": "imm"})
    for name in ("speed-rule", "imm"):
        decisions.add(contender_from(name, "handset"), episodes, told[name])
    content = decisions.json["stop"]
    assert list(content["error_m"]) == ["fixed-a", "imm"]
    assert list(content["share"]) == ["fixed-a"]  # whatever its name, a rule decides


def test_without_events_there_are_no_numbers(episodes, told, tmp_path):
    still = [replace(e, truth_velocity_mps=np.zeros((T, 3))) for e in episodes]
    decisions = collected(still, told)
    content = json.loads(json.dumps(decisions.json, allow_nan=False))
    for kind in ("stop", "pull-away"):
        assert content[kind]["events"] == 0
        assert set(content[kind]["error_m"]["imm"]) == {None}
    draw_decisions(decisions, tmp_path / "none.png")


def test_a_picture_is_drawn(episodes, told, tmp_path):
    draw_decisions(collected(episodes, told), tmp_path / "some.png")
    ruled = collected(episodes, {name: told[name] for name in ("imm", "fixed-ukf")})
    draw_decisions(ruled, tmp_path / "without.png")
    some, without = (imread(tmp_path / f"{name}.png") for name in ("some", "without"))
    assert (some != 1.0).any(axis=2).mean() > 0.2  # shares fill their panels
    assert (without != 1.0).any(axis=2).mean() > 0.01
    assert some.shape[0] > without.shape[0]  # a row for the rule


@pytest.mark.filterwarnings("ignore:speed above 20 m/s")  # of a track that is lost
def test_modes_are_those_that_were_chosen(episodes):
    rule = contender_from("speed-rule", "handset")
    told = run_contender(rule, rule.start(SOURCE.layout), episodes)
    assert told["mode"].shape == (N, T) and set(np.unique(told["mode"])) == {0, 1}
    for mode, name in enumerate(("fixed-ekf", "fixed-ukf")):
        fixed = contender_from(name, "handset")
        assert (run_contender(fixed, fixed.start(SOURCE.layout), episodes)["mode"] == mode).all()
    imm = contender_from("imm", "handset")
    assert "mode" not in run_contender(imm, imm.start(SOURCE.layout), episodes)


def test_where_modes_keep_a_belief_each_the_shares_are_of_whom_it_trusts(episodes, told):
    own = Contender.own("mine", np.zeros_like, "handset", HANDSET, beliefs="per-mode")
    decisions = Decisions({"mine": "mine"})
    actions = np.random.default_rng(3).integers(4, size=(N, T))
    decisions.add(own, episodes, {"error": told["imm"]["error"], "mode": actions})
    shares = decisions.json["stop"]["share"]["mine"]
    assert list(shares) == ["none", "stand", "walk", "ride"]
    assert np.sum([shares[name] for name in shares], axis=0) == pytest.approx(np.ones(31))
    speed = np.stack([np.linalg.norm(episode.truth_velocity_mps, axis=1) for episode in episodes])
    there = [(e, t) for e, t in np.argwhere(fast_stops(speed, 1.0)) if t >= BURN_IN]
    assert shares["ride"][10] == pytest.approx(np.mean([actions[at] == 3 for at in there]))
