"""Tests of the window that shows pictures: its pause and closing, and what it shows."""

import gymnasium as gym
import numpy as np
import pygame
import pytest

from mmwave_env.rendering.window import Window

ID = "mmwave_env:MmWaveLoc-v0"


@pytest.fixture
def window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Window(960, 480, 100)
    yield window
    window.close()


PICTURE = np.random.default_rng(0).integers(0, 256, (480, 960, 3), np.uint8)


def press_space():
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_SPACE))


def test_space_begins_and_ends_a_pause(window, monkeypatch):
    waits = []

    def wait(milliseconds):
        assert window.paused
        waits.append(milliseconds)
        if len(waits) == 3:
            press_space()

    monkeypatch.setattr(pygame.time, "wait", wait)
    press_space()
    window.show(PICTURE)
    assert len(waits) == 3 and not window.paused


def test_a_closed_window_stays_closed_and_does_not_wait(window):
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    window.show(PICTURE)
    assert not pygame.display.get_init() and not window.is_open
    window.paused = True
    window.show(PICTURE)


def test_an_environment_shows_every_epoch_from_the_prior_on(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    shown = []
    monkeypatch.setattr(Window, "show", lambda self, picture: shown.append(picture.shape))
    env = gym.make(ID, render_mode="human", episode_steps=4, render_size=600)
    for seed in range(2):
        env.reset(seed=seed)
        for _ in range(4):
            env.step(1)
    assert shown == [(600, 600, 3)] * 10
    assert pygame.display.get_surface().get_size() == (600, 600)
    env.close()
    assert not pygame.display.get_init()


def test_a_picture_is_shown_unchanged(window):
    window.show(PICTURE)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, PICTURE)


def test_a_window_outlives_another(window):
    other = Window(960, 480, 100)
    other.close()
    window.show(PICTURE)
    assert window.is_open and not other.is_open
