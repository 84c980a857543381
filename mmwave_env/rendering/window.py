"""A window that shows pictures, and listens to keys."""

import os
import time
from typing import Any

import numpy as np
import pygame
from numpy.typing import NDArray

from mmwave_env.rendering.canvas import written
from mmwave_env.rendering.theme import FRAMES_PER_SECOND, SMALLEST

SPEEDS = (1, 2, 5, 10, 20, 50, 100)  # pictures a second
_STEP, _FASTER, _SLOWER = (
    (pygame.K_n, pygame.K_RIGHT),
    (pygame.K_PLUS, pygame.K_EQUALS, pygame.K_KP_PLUS, pygame.K_UP),
    (pygame.K_MINUS, pygame.K_KP_MINUS, pygame.K_DOWN),
)
_KEYS = (
    "space   pause, go on",
    "n   one epoch",
    "+   faster",
    "-   slower",
    "h   these keys",
)
_UNSEEN = {"offscreen", "dummy"}  # drivers of windows that nobody sees


def require_display(
    what: str = 'render_mode="human"', instead: str = 'take render_mode="rgb_array"'
) -> None:
    """Refuse a window that nobody would see.

    Args:
        what: needs it.
        instead: what to do without one.

    Raises:
        OSError: there is no display; the message says which variable is missing.
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
            f"{what}: found no display (SDL: {driver}), expected one: set the variable DISPLAY or "
            f"WAYLAND_DISPLAY, or {instead}"
        )


class Window:
    """Shows one picture after another, at a speed that keys change.

    Once it is closed on the screen, nothing is shown any more, and nothing waits.

    Args:
        width, height: px.
    """

    def __init__(self, width: int, height: int) -> None:
        require_display()
        pygame.display.set_caption("MmWaveLoc-v0")
        self._screen: Any = pygame.display.set_mode((width, height))
        self._unit, self._shown_s = height / SMALLEST, 0.0
        self.paused, self.helping, self.speed = False, False, FRAMES_PER_SECOND
        self._stepping = False

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture (height, width, 3) as long as the speed wants; paused, until a key."""
        height, width, _ = picture.shape
        surface = pygame.image.frombuffer(picture.tobytes(), (width, height), "RGB")
        self._stepping = False
        while self._screen is not None:
            self._listen()
            if self._screen is None or self._stepping:
                break
            if not self.paused and time.monotonic() >= self._shown_s + 1.0 / self.speed:
                break
            self._draw(surface)
            pygame.time.wait(5)
        self._draw(surface)
        self._shown_s = time.monotonic()

    @property
    def is_open(self) -> bool:
        """Whether it is still there."""
        return self._screen is not None

    def close(self) -> None:
        """Close it, if it is open."""
        if self._screen is not None:
            pygame.display.quit()
            self._screen = None

    def _listen(self) -> None:
        """Do what was asked for since the last time, up to a single step."""
        while not self._stepping and self._screen is not None:
            event = pygame.event.poll()
            if event.type == pygame.NOEVENT:
                return
            if event.type == pygame.QUIT:
                self.close()
            elif event.type == pygame.KEYDOWN:
                self._press(event.key)

    def _press(self, key: int) -> None:
        if key == pygame.K_SPACE:
            self.paused = not self.paused
        elif key == pygame.K_h:
            self.helping = not self.helping
        elif key in _STEP:
            self.paused = self._stepping = True
        elif key in _FASTER:
            self.speed = next((speed for speed in SPEEDS if speed > self.speed), SPEEDS[-1])
        elif key in _SLOWER:
            self.speed = next((speed for speed in SPEEDS[::-1] if speed < self.speed), SPEEDS[0])

    def _draw(self, surface: Any) -> None:
        """The picture, with the keys or how to see them in its corner."""
        if self._screen is None:
            return
        state = "paused" if self.paused else f"{self.speed} pictures a second"
        lines = [*_KEYS, state] if self.helping else [f"{state}, h for keys"]
        size = round(15 * self._unit)
        drawn = [written(line, (255, 255, 255), size) for line in lines]
        height, pad = round(18 * self._unit), round(8 * self._unit)
        width = max(line.get_width() for line in drawn) + 2 * pad
        plate = pygame.Surface((width, height * len(drawn) + pad))
        top = round(46 * self._unit)  # below a title and the numbers
        self._screen.blit(surface, (0, 0))
        self._screen.blit(plate, (pad, top))
        for i, line in enumerate(drawn):
            self._screen.blit(line, (2 * pad, top + pad // 2 + i * height + 3))
        pygame.display.flip()
