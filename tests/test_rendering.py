"""Pictures of an episode: what is in them, and when there is none."""

import gymnasium as gym
import numpy as np
import pytest

from mmwave_env.env import MmWaveLocEnv
from mmwave_env.rendering import SIZE, Picture

pytest.importorskip("pygame")

ID = "mmwave_env:MmWaveLoc-v0"


def orange(picture: np.ndarray) -> np.ndarray:
    """Where the second mode's color is, blended into the paper or not."""
    red, green, blue = np.moveaxis(picture.astype(int), -1, 0)
    return (red > 240) & (green - blue > 60)


def colors(picture: np.ndarray) -> set[tuple[int, int, int]]:
    return {tuple(int(v) for v in pixel) for pixel in picture.reshape(-1, 3)}


def test_an_array_for_every_step_and_more_track_with_time() -> None:
    env = gym.make(ID, render_mode="rgb_array", scenario="vehicle")
    env.reset(seed=0)
    blank = env.render()
    assert blank.shape == (SIZE, SIZE, 3) and len(colors(blank)) == 1
    lengths = []
    for _ in range(3):
        for _ in range(20):
            env.step(1)
        picture = env.render()
        assert picture.shape == (SIZE, SIZE, 3) and picture.dtype == np.uint8
        lengths.append(int(orange(picture).sum()))
    assert 0 < lengths[0] < lengths[1] < lengths[2]
    env.reset(seed=1)
    assert len(colors(env.render())) == 1
    env.close()


def test_track_is_colored_by_the_mode_that_ran() -> None:
    env = gym.make(ID, render_mode="rgb_array", scenario="vehicle")
    env.reset(seed=0)
    for _ in range(40):
        env.step(0)
    assert not orange(env.render()).any()


def test_a_window_opens_follows_the_episode_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.make(ID, render_mode="human", episode_steps=4)
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(4):
            env.step(1)
        assert pygame.display.get_surface().get_size() == (SIZE, SIZE)
    env.close()
    assert not pygame.display.get_init()


def test_belief_is_drawn_where_it_is() -> None:
    picture = Picture(["ekf", "ukf"])
    anchors = np.array([[0.0, 0.0, 10.0]])
    truth = np.array([[-50.0, -50.0, 1.5], [50.0, 50.0, 1.5]])
    picture.begin(anchors, truth)
    drawn = picture.draw(
        truth[:1], truth[1:], np.eye(2), np.array([1]), np.array([True]), np.array([False])
    )
    rows, columns = np.nonzero(orange(drawn))
    assert rows.max() < SIZE / 2 < columns.min()  # north-east of the anchor in the middle


def test_without_a_render_mode_there_is_no_picture() -> None:
    env = gym.make(ID).unwrapped
    env.reset(seed=0)
    assert env.render() is None
    with pytest.raises(ValueError, match="render_mode: found 'ansi'.*human, rgb_array"):
        MmWaveLocEnv(render_mode="ansi")
