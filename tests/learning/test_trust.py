"""Whom a policy trusts around events, against means written out."""

import json

import numpy as np
import pytest
from matplotlib.image import imread

from experiments.evaluation.contenders import Contender, contenders
from experiments.evaluation.runner import run_contender
from experiments.evaluation.seeds import draw_episodes
from experiments.learning.trust import EVENTS, Trust
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from tests.training.actors import HANDSET

SOURCE = SimulatedSource(SCENES["street"], RADIOS["handset"], "vehicle", epochs=60)
ACTIONS = ["none", "stand", "walk", "ride"]


def by_turns(observations):
    """Trusts none and each mode, one environment after the other."""
    return np.arange(len(observations)) % len(ACTIONS)


@pytest.fixture(scope="module")
def episodes():
    return draw_episodes(SOURCE, range(10))


@pytest.fixture(scope="module")
def policy():
    return Contender.own("runs/mine", by_turns, "handset", HANDSET, beliefs="per-mode")


@pytest.fixture(scope="module")
def imm():
    return contenders("handset", HANDSET)["imm"]()


@pytest.fixture(scope="module")
def trust(policy, imm, episodes):
    return Trust.measured(policy, imm, episodes)


def test_numbers_are_means_over_events(trust, policy, imm, episodes):
    assert trust.time_s.tolist() == list(range(-10, 11))
    name = "mixture.probability"
    told = run_contender(policy, policy.start(SOURCE.layout), episodes, shown=[name])
    error = np.linalg.norm(told["error"], axis=-1)
    other = np.linalg.norm(run_contender(imm, None, episodes)["error"], axis=-1)
    assert set(trust.around) == {"stop", "pull-away", "turn", "blockage"}
    for kind, found in trust.around.items():
        events = np.argwhere(EVENTS[kind](episodes))
        assert found.events == len(events) > 0
        for i, offset in enumerate(range(-10, 11)):
            at = tuple(
                np.array([(e, t + offset) for e, t in events if BURN_IN <= t + offset < 60]).T
            )
            share = np.bincount(told["mode"][at], minlength=len(ACTIONS)) / len(at[0])
            assert found.trusted[:, i] == pytest.approx(share)
            assert found.probability[:, i] == pytest.approx(told[name][at].mean(axis=0))
            assert found.error_m["mine"][i].mean == pytest.approx(error[at].mean())
            assert found.error_m["imm"][i].mean == pytest.approx(other[at].mean())
            assert found.gain_m[i].mean == pytest.approx((error - other)[at].mean(), abs=1e-9)


def test_whom_it_trusts_has_shares_of_one(trust):
    for found in trust.around.values():
        assert found.trusted.sum(axis=0) == pytest.approx(np.ones(21))
        assert found.probability.sum(axis=0) == pytest.approx(np.ones(21))


def test_trusting_none_gains_nothing(imm, episodes):
    none = Contender.own(
        "none", lambda seen: np.zeros(len(seen), int), "handset", HANDSET, beliefs="per-mode"
    )
    for found in Trust.measured(none, imm, episodes).around.values():
        assert (found.trusted[0] == 1.0).all()
        assert [gain.mean for gain in found.gain_m] == pytest.approx(np.zeros(21), abs=1e-6)


def test_the_table_says_what_the_figure_shows(trust):
    header, _, *rows = [line.strip("| ").split(" | ") for line in str(trust).splitlines()]
    assert header == ["event", "time s", *ACTIONS, "error of mine m", "minus imm m"]
    assert len(rows) == 3 * len(EVENTS)
    assert [row[1] for row in rows[:3]] == ["-3", "0", "+3"]
    turn = trust.around["turn"]
    (after,) = (row for row in rows if row[:2] == ["turn", "+3"])
    assert after[2:6] == [f"{share:.2f}" for share in turn.trusted[:, 13]]
    assert after[6:] == [str(turn.error_m["mine"][13]), str(turn.gain_m[13])]


def test_without_events_there_are_no_numbers(policy, imm, tmp_path):
    short = SimulatedSource(SCENES["street"], RADIOS["handset"], "pedestrian", epochs=2)
    trust = Trust.measured(policy, imm, draw_episodes(short, range(2)))
    content = json.loads(json.dumps(trust.json, allow_nan=False))
    assert content["turn"]["events"] == 0
    assert set(content["turn"]["trusted"]["ride"]) == {None}
    trust.draw(tmp_path / "none.png")


@pytest.mark.slow
def test_a_picture_is_drawn(trust, tmp_path):
    trust.draw(tmp_path / "trust.png")
    assert (imread(tmp_path / "trust.png") != 1.0).any(axis=2).mean() > 0.3  # shares fill panels
