"""Tests of the benchmark's protocol: its sites, and the entries of its leaderboard.

A *site* is a source of episodes; an *entry* holds the results of one policy at all sites.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.protocol import (
    BESIDE,
    HARD_SOURCES,
    KINDS,
    TRAINED,
    UNSEEN,
    entries_in,
    entry,
    figures_of,
    judge,
    mean_gain,
    name_or_file,
    score_at,
    sealed,
    sites,
    standing,
    tables_of,
)
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, scene_from
from tests.paths import write_json


def test_unseen_scenes_and_radios_are_not_shipped_and_the_scenes_differ():
    assert not set(UNSEEN) & {*SCENES, *RADIOS}
    scenes = [scene_from(name_or_file(name)) for name in UNSEEN[:-1]]
    for scene in scenes:
        scene.require_streets_in_front()
        assert len(scene.anchors_m) == 3
    assert len({scene.carrier_hz for scene in scenes}) > 1
    assert len({scene.streets for scene in scenes}) == len(scenes)


def test_the_protocol_has_the_documented_numbers_of_sites():
    kinds = [site.kind for site in sites()]
    assert [kinds.count(kind) for kind in KINDS] == [9, 7, 8, 6]
    assert len({site.name for site in sites()}) == 30
    assert all(site.source().layout.anchors == 3 for site in sites())


@pytest.mark.slow  # compiles every IMM
def test_a_policy_is_compared_with_every_imm_on_the_same_episodes():
    (site,) = (site for site in sites() if site.name == "street:tablet")
    scores = judge(["speed-rule", "imm-best"], site, 4, seed=3)
    figures = figures_of("speed-rule", site, scores)
    reward = scores["speed-rule"]["reward"]
    expected = (reward - scores["imm"]["reward"]).mean()
    assert figures["minus"]["imm"]["mean"] == pytest.approx(expected)
    assert figures["reward"]["mean"] == pytest.approx(reward.mean())
    assert "imm-best" not in figures_of("imm-best", site, scores)["minus"]


@pytest.mark.parametrize(
    ("gains", "expected"), [((0.1, 0.2), "above"), ((0.1, 0.0), "level"), ((0.1, -0.2), "below")]
)
def test_an_entry_is_above_or_below_the_imms_or_level_with_them(gains, expected):
    rng = np.random.default_rng(0)
    base = rng.normal(size=400)
    noise = rng.normal(0.0, 0.1, 400)
    noise -= noise.mean()
    rewards = {"mine": base, "imm": base - gains[0] + noise, "imm-best": base - gains[1] - noise}
    rewards["speed-rule"] = base
    scores = {name: {"reward": reward, "ate_m": base} for name, reward in rewards.items()}
    assert standing(figures_of("mine", sites()[0], scores)) == expected


def entries():
    """Return entries whose rewards are constant at every site."""
    rewards = {"mine": -2.0, "imm-best": -2.5, "speed-rule": -3.0, "clairvoyant": -1.0}
    scores = {
        name: dict.fromkeys(("reward", "ate_m"), np.full(3, r)) for name, r in rewards.items()
    }
    judged = dict.fromkeys(sites(), scores)
    return {name: entry(name, judged) for name in rewards}


def test_the_speed_rule_has_score_0_and_the_clairvoyant_100_at_every_site():
    made = entries()
    ceiling = made["clairvoyant"]
    for name, expected in {"mine": 50, "imm-best": 25, "speed-rule": 0, "clairvoyant": 100}.items():
        assert {score_at(site, made[name], ceiling) for site in sites()} == {expected}
    tables = tables_of(made)
    for site in sites():
        assert f"| {site.name} | 2.000 [2.000, 2.000] | 50 | 25 | 0 |" in tables


def test_scores_are_dashes_if_an_entry_has_fewer_episodes_than_the_clairvoyant():
    content = entries()["mine"]
    ceiling = entries()["clairvoyant"]
    assert mean_gain(content, TRAINED) == 0.5 and mean_gain(entries()["imm-best"], TRAINED) == 0.0
    for episodes, shown in ((3, "50"), (2, "-")):  # the clairvoyant played three episodes
        for at in content["sites"].values():
            at["episodes"] = episodes
        tables = tables_of({"clairvoyant": ceiling, "mine": content})
        assert tables.endswith(f"| {shown} |")
        assert "| 0.500, 6 / 0 / 0 |\n\nMean score" in tables
        assert f" | {shown} |\n| street:standard" in tables


def test_an_entry_in_the_folder_replaces_the_shipped_entry_of_the_same_policy(tmp_path):
    shipped = entries_in(tmp_path)
    assert [*shipped] == [*BESIDE]
    write_json(tmp_path / "mine.json", sealed(shipped["clairvoyant"] | {"command": "mine"}))
    own = entries_in(tmp_path)
    assert own.keys() == {*BESIDE} and own["clairvoyant"]["command"] == "mine"


@pytest.fixture(scope="module")
def hard():
    """Return four episodes of every hard site."""
    keys = np.arange(4, dtype=np.uint64)
    return {name.split(":")[0]: make().episodes(keys) for name, make in HARD_SOURCES.items()}


def test_a_car_turns_at_square_corners_at_10_mps(hard):
    for episode in hard["corners"]:
        moved = np.diff(episode.truth_position_m[:, :2], axis=0)
        assert_allclose(np.linalg.norm(moved, axis=1), 10.0)
        straight = (moved[:-1] * moved[1:]).sum(axis=1) / 100.0  # cosine of the change of heading
        assert set(np.round(straight, 9)) == {0.0, 1.0}
        assert (np.diff(np.flatnonzero(straight < 0.5)) == 8).all()


def test_a_bus_stops_every_300_m(hard):
    for episode in hard["bus"]:
        gone = np.cumsum(np.linalg.norm(np.diff(episode.truth_position_m, axis=0), axis=1))
        stands = np.append(False, np.diff(gone) < 1e-9)
        stops = gone[np.flatnonzero(np.diff(stands.astype(int)) == 1)]
        assert len(stops) >= 3 and np.diff(stops) == pytest.approx(300.0)


def test_hard_sites_have_the_receiver_faults_in_their_names(hard):
    ordinary = next(s for s in sites() if s.name == "street:handset").source()
    keys = np.arange(4, dtype=np.uint64)
    for stated, true in zip(hard["noise-twice"], ordinary.episodes(keys), strict=True):
        assert_array_equal(stated.measurement, true.measurement)
        assert_allclose(stated.sigma, 0.5 * true.sigma)
    assert all(episode.layout.clock for episode in hard["clock-offset"])
    for episode in hard["range-azimuth"]:
        links = np.isfinite(episode.measurement[:, :12]).reshape(-1, 3, 4).any(axis=(0, 1))
        assert links.tolist() == [True, True, False, False]
        assert np.isnan(episode.measurement[:, 12]).all()
