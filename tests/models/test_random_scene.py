"""Scenes drawn at random: what holds for all of them, and what is refused."""

import re

import gymnasium as gym
import numpy as np
import pytest

from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene, scenes_from
from mmwave_env.models.scene import SCENES
from mmwave_env.world.keys import keys_of
from mmwave_env.world.mobility import MOBILITIES
from mmwave_env.world.simulated import SimulatedSource
from tests.world.roads import around_a_block

SOURCE = SimulatedSource(RandomScene(), RADIOS["handset"])
DRAWN = [SOURCE.scene_of(int(key)) for key in keys_of(range(2000))]


def test_users_and_base_station_are_before_both_walls():
    for scene in DRAWN:
        scene.require_streets_in_front()
        assert len(scene.anchors_m) == 3


def test_what_is_drawn_fills_its_ranges():
    ranges = RandomScene()
    block = np.array([scene.streets.block_m for scene in DRAWN])
    height = np.array([scene.base_station_m[2] for scene in DRAWN])
    for values, (low, high) in ((block, ranges.block_m), (height, ranges.height_m)):
        assert low <= values.min() and values.max() <= high
        assert values.min() < low + 0.02 * (high - low) and values.max() > high - 0.02 * (
            high - low
        )
    blocks = {
        tuple(round((high - low) / scene.streets.block_m) for low, high in
              (scene.streets.x_m, scene.streets.y_m))
        for scene in DRAWN
    }  # fmt: skip
    assert blocks == {(x, y) for x in range(4) for y in range(4)} - {(0, 0)}
    sides = {tuple(wall.offset_m > 0.0 for wall in scene.walls) for scene in DRAWN}
    assert len(sides) == 4


def test_the_base_station_is_near_a_crossing_and_the_walls_behind_what_is_farthest_out():
    ranges = RandomScene()
    for scene in DRAWN:
        block, base = scene.streets.block_m, np.array(scene.base_station_m[:2])
        ends = np.array([scene.streets.x_m[1], scene.streets.y_m[1]])
        crossing = np.clip(np.round(base / block) * block, 0.0, ends)
        beside = np.abs(base - crossing)
        assert (ranges.beside_m[0] - 1e-9 <= beside).all()
        assert (beside <= ranges.beside_m[1] + 1e-9).all()
        for axis, wall in enumerate(scene.walls):
            out = max(ends[axis], base[axis]), min(0.0, base[axis])
            behind = wall.offset_m - out[0] if wall.offset_m > 0.0 else out[1] - wall.offset_m
            assert ranges.behind_m[0] - 1e-9 <= behind <= ranges.behind_m[1] + 1e-9


def test_every_episode_has_a_scene_of_its_own_and_a_seed_gives_it_again():
    def drawn(seed):
        env = gym.make("mmwave_env:MmWaveLoc-v0", scene="random", episode_steps=3)
        first, _ = env.reset(seed=seed)
        second, _ = env.reset()
        return first, second

    np.testing.assert_array_equal(drawn(3), drawn(3))
    anchors = {scene.base_station_m for scene in DRAWN}
    assert len(anchors) == len(DRAWN)


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (
            {"block_m": (0.0, 80.0)},
            "block_m: found (0.0, 80.0), expected [low, high], each 0.001 to 10000 m",
        ),
        ({"height_m": (9.0, 8.0)}, "height_m: found (9.0, 8.0), expected low <= high"),
        ({"blocks": 0}, "blocks: found 0, expected an integer of 1 to 30"),
    ],
)
def test_ranges_that_hold_nothing_are_refused(arguments, found):
    with pytest.raises(ValueError, match=f"^{re.escape(found)}$"):
        RandomScene(**arguments)


def test_users_that_find_no_room_in_the_closest_streets_are_refused():
    tight = RandomScene(block_m=(10.0, 140.0))
    with pytest.raises(ValueError, match="corner_radius_m of mobility 'vehicle': .* 10 m between"):
        gym.make("mmwave_env:MmWaveLoc-v0", scene=tight, scenario=MOBILITIES["vehicle"])


def test_a_way_needs_one_scene():
    with pytest.raises(ValueError, match="scene: found 'random', expected one scene: block is a"):
        gym.make("mmwave_env:MmWaveLoc-v0", scene="random", scenario=around_a_block())


def test_names_and_what_they_stand_for():
    assert scenes_from("random") == RandomScene()
    assert scenes_from("o1") is SCENES["o1"]
    with pytest.raises(
        ValueError, match="scene: found 'randm', did you mean random[?] Expected .*random"
    ):
        scenes_from("randm")
