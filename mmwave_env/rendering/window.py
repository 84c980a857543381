"""Window that shows pictures."""

import os
import time
from typing import Any

import pygame

from mmwave_env.rendering.theme import FRAMES_PER_SECOND, Pixels

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
    """A window that shows one picture after another, ``speed`` per second.

    Space begins or ends a pause. After the user closes the window, :meth:`show` returns
    immediately. Several objects share the one window that pygame has.
    """

    _sharing = 0  # number of objects whose window is open

    def __init__(self, width: int, height: int, speed: int = FRAMES_PER_SECOND) -> None:
        require_display()
        self._screen: Any = pygame.display.set_mode((width, height))
        Window._sharing += 1
        pygame.display.set_caption("MmWaveLoc-v0 (space: pause)")
        self._shown_s = 0.0
        self._speed = speed
        self.paused = False

    def show(self, picture: Pixels) -> None:
        """Show a picture (height, width, 3) until the next is due."""
        surface = pygame.image.frombuffer(picture.tobytes(), picture.shape[1::-1], "RGB")
        while self._screen is not None:
            self._screen.blit(surface, (0, 0))
            pygame.display.flip()
            for event in pygame.event.get():
                if event.type == pygame.KEYDOWN and event.key == pygame.K_SPACE:
                    self.paused = not self.paused
                elif event.type == pygame.QUIT:
                    self.close()
                    return
            if not self.paused and time.monotonic() >= self._shown_s + 1.0 / self._speed:
                break
            pygame.time.wait(5)
        self._shown_s = time.monotonic()

    @property
    def is_open(self) -> bool:
        """Return whether the window is open."""
        return self._screen is not None

    def close(self) -> None:
        """Close the window if it is open."""
        if self._screen is None:
            return
        self._screen = None
        Window._sharing -= 1
        if not Window._sharing:
            pygame.display.quit()
