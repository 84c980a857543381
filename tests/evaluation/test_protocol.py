"""Tests of the leaderboard's protocol: its sites, unseen streets, and the standing of an entry."""

import numpy as np
import pytest

from experiments.evaluation.protocol import (
    KINDS,
    RECORDED,
    TRAINED,
    UNSEEN,
    Judged,
    entry,
    judge,
    sites,
    standing,
    unseen_file,
)
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, scene_from


def test_unseen_sites_are_not_among_the_shipped_scenes_and_radios():
    assert not set(UNSEEN) & {*SCENES, *RADIOS}


def test_unseen_streets_differ_in_carrier_and_geometry():
    scenes = [scene_from(unseen_file(name)) for name in UNSEEN[:-1]]
    for scene in scenes:
        scene.require_streets_in_front()
        assert len(scene.anchors_m) == 3
    assert len({scene.carrier_hz for scene in scenes}) > 1
    assert len({scene.streets for scene in scenes}) == len(scenes)


def test_the_protocol_has_the_documented_numbers_of_sites():
    kinds = [site.kind for site in sites()]
    assert [kinds.count(kind) for kind in KINDS] == [9, 7, 4]
    assert len({site.name for site in sites()}) == 20
    assert all(site.source.layout.anchors == 3 for site in sites())


@pytest.mark.slow  # compiles every IMM
def test_a_contender_is_compared_with_every_imm_on_the_same_episodes():
    (site,) = (site for site in sites() if site.name == "street:tablet")
    judged = judge(["speed-rule", "imm-best"], site, 4, seed=3)
    assert judged.imms == ("imm", "imm-best")
    figures = judged.figures("speed-rule")
    expected = judged.gain("speed-rule", "imm").mean()
    assert figures["minus"]["imm"]["mean"] == pytest.approx(expected)
    assert figures["reward"]["mean"] == pytest.approx(judged.scores["speed-rule"]["reward"].mean())
    assert "imm-best" not in judged.figures("imm-best")["minus"]
    low, high = entry("imm-best", [judged])["mean_gain"]["unseen"]["ci95"]
    assert low == high == 0.0


@pytest.mark.parametrize(
    ("gains", "expected"), [((0.1, 0.2), "above"), ((0.1, 0.0), "level"), ((0.1, -0.2), "below")]
)
def test_an_entry_is_above_or_below_the_imms_or_level_with_them(gains, expected):
    rng = np.random.default_rng(0)
    base, noise = rng.normal(size=400), rng.normal(0.0, 0.1, 400)
    noise -= noise.mean()
    rewards = {"mine": base, "imm": base - gains[0] + noise, "imm-best": base - gains[1] - noise}
    scores = {name: {"reward": reward, "ate_m": base} for name, reward in rewards.items()}
    judged = Judged(sites()[0], scores, ("imm", "imm-best"))
    assert standing(judged.figures("mine")) == expected
    assert entry("mine", [judged])["mean_gain"][TRAINED]["mean"] == pytest.approx(gains[1])
    assert RECORDED not in entry("mine", [judged])["mean_gain"]
