"""Window that shows pictures and reacts to keys."""

import os
import time
from typing import Any

import pygame

from mmwave_env.rendering.theme import FRAMES_PER_SECOND, Pixels

SPEEDS = (1, 2, 5, 10, 20, 50, 100)  # pictures per second
_STEP = (pygame.K_n, pygame.K_RIGHT)
_FASTER = (pygame.K_PLUS, pygame.K_EQUALS, pygame.K_KP_PLUS, pygame.K_UP)
_SLOWER = (pygame.K_MINUS, pygame.K_KP_MINUS, pygame.K_DOWN)
_UNSEEN = {"offscreen", "dummy"}  # video drivers without a visible window


def require_display(
    purpose: str = 'render_mode="human"', instead: str = 'use render_mode="rgb_array"'
) -> None:
    """Refuse a window that nobody would see; ``purpose`` and ``instead`` are parts of the message.

    Raises:
        OSError: there is no display; the message names variables that select a display.
    """
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
    except pygame.error as problem:
        driver = str(problem)
    asked = os.environ.get("SDL_VIDEODRIVER", os.environ.get("SDL_VIDEO_DRIVER"))
    if not pygame.display.get_init() or (driver in _UNSEEN and driver != asked):
        pygame.display.quit()
        raise OSError(
            f"{purpose}: found no display (SDL: {driver}); set the variable DISPLAY or "
            f"WAYLAND_DISPLAY, or {instead}"
        )


class Window:
    """A window that shows one picture after another, at a speed that the user changes with keys.

    The title lists the keys. Space begins or ends a pause; n shows the next picture and begins a
    pause. After the user closes the window, :meth:`show` returns immediately.
    """

    def __init__(self, width: int, height: int) -> None:
        require_display()
        self._screen: Any = pygame.display.set_mode((width, height))
        self._shown_s = 0.0
        self._stepping = False
        self.paused = False
        self.speed = FRAMES_PER_SECOND
        self._name()

    def show(self, picture: Pixels) -> None:
        """Show a picture (height, width, 3) until the next is due or asked for."""
        surface = pygame.image.frombuffer(picture.tobytes(), picture.shape[1::-1], "RGB")
        self._stepping = False
        while self._screen is not None:
            self._screen.blit(surface, (0, 0))
            pygame.display.flip()
            self._listen()
            over = not self.paused and time.monotonic() >= self._shown_s + 1.0 / self.speed
            if over or self._stepping:
                break
            pygame.time.wait(5)
        self._shown_s = time.monotonic()

    @property
    def is_open(self) -> bool:
        """Return whether the window is open."""
        return self._screen is not None

    def close(self) -> None:
        """Close the window if it is open."""
        if self._screen is not None:
            pygame.display.quit()
            self._screen = None

    def _listen(self) -> None:
        """Handle the events since the last call, until one of them asks for a single step."""
        while self._screen is not None and not self._stepping:
            event = pygame.event.poll()
            if event.type == pygame.NOEVENT:
                return
            if event.type == pygame.QUIT:
                self.close()
            elif event.type == pygame.KEYDOWN:
                self._press(event.key)
                self._name()

    def _press(self, key: int) -> None:
        if key == pygame.K_SPACE:
            self.paused = not self.paused
        elif key in _STEP:
            self.paused = self._stepping = True
        elif key in _FASTER:
            self.speed = next((speed for speed in SPEEDS if speed > self.speed), SPEEDS[-1])
        elif key in _SLOWER:
            self.speed = next((speed for speed in SPEEDS[::-1] if speed < self.speed), SPEEDS[0])

    def _name(self) -> None:
        state = "paused" if self.paused else f"{self.speed} pictures per second"
        pygame.display.set_caption(f"MmWaveLoc-v0, {state} (space: pause, n: one epoch, + and -)")
