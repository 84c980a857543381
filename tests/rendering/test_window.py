"""Tests of the window that shows pictures: its keys, speed and closing, and what it shows."""

import gymnasium as gym
import numpy as np
import pygame
import pytest

from mmwave_env.rendering.window import SPEEDS, Window

ID = "mmwave_env:MmWaveLoc-v0"


@pytest.fixture
def window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Window(480, 480)
    window.speed = SPEEDS[-1]
    yield window
    window.close()


def press(*keys):
    for key in keys:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))


PICTURE = np.zeros((480, 480, 3), np.uint8)


def test_the_window_stays_paused_after_single_steps_until_space_is_pressed(window):
    press(pygame.K_SPACE, pygame.K_n)
    window.show(PICTURE)
    assert window.paused
    press(pygame.K_n)
    window.show(PICTURE)
    assert window.paused
    press(pygame.K_SPACE)
    window.show(PICTURE)
    assert not window.paused


def test_the_speed_keys_stop_at_the_lowest_and_highest_speed(window):
    press(pygame.K_PLUS)
    window.show(PICTURE)
    assert window.speed == SPEEDS[-1]
    press(pygame.K_MINUS, pygame.K_DOWN)
    window.show(PICTURE)
    assert window.speed == SPEEDS[-3]
    press(*[pygame.K_MINUS] * 9, pygame.K_UP, pygame.K_n)
    window.show(PICTURE)
    assert window.speed == SPEEDS[1]


def test_a_closed_window_stays_closed_and_does_not_wait(window):
    pygame.event.post(pygame.event.Event(pygame.QUIT))
    window.show(PICTURE)
    assert not pygame.display.get_init()
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


def test_a_picture_is_shown_unchanged(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    wide = Window(960, 480)
    picture = np.random.default_rng(0).integers(0, 256, (480, 960, 3), np.uint8)
    wide.show(picture)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, picture)
    wide.close()
    assert not wide.is_open
