"""A picture of an episode from above, drawn with pygame (extra `render`)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.numerics.arrays import Array

SIZE = 480
MARGIN_M = 15.0
FRAMES_PER_SECOND = 10
_PAPER, _INK, _FAINT = (250, 250, 247), (40, 40, 40), (205, 205, 200)
_TRUTH, _ACCEPTED, _REJECTED = (90, 90, 90), (120, 180, 120), (215, 80, 70)
_MODES = ((31, 119, 180), (255, 127, 14), (44, 160, 44), (148, 103, 189), (140, 86, 75))
_ELLIPSE_95 = 5.991  # chi-square quantile, 2 axes


class Picture:
    """Draws epochs: the anchors, the true and the estimated track, the belief and its links.

    Args:
        modes: names of the modes.
        on_screen: open a window instead of drawing in memory.
    """

    def __init__(self, modes: Sequence[str], on_screen: bool = False) -> None:
        import pygame

        self._pygame: Any = pygame
        self._modes = modes
        self._anchors, self._center, self._pixels_per_m = np.zeros((0, 3)), np.zeros(2), 1.0
        pygame.font.init()
        self._font = pygame.font.Font(None, 20)
        self._window = None
        if on_screen:
            pygame.display.init()
            pygame.display.set_caption("MmWaveLoc-v0")
            self._window = pygame.display.set_mode((SIZE, SIZE))
            self._clock = pygame.time.Clock()
        self._canvas = pygame.Surface((SIZE, SIZE))

    def begin(self, anchors_m: Array, truth_m: Array) -> None:
        """Frame an episode: anchors (L, 3), and the true track (T, 3) to its end."""
        points = np.vstack([truth_m[:, :2], anchors_m[:1, :2]])
        low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
        self._anchors, self._center = anchors_m, (low + high) / 2.0
        self._pixels_per_m = SIZE / float((high - low).max())

    def draw(
        self,
        truth_m: Array,
        track_m: Array,
        P: Array,
        modes: NDArray[np.int64],
        accepted: Array,
        rejected: Array,
    ) -> NDArray[np.uint8]:
        """Draw an epoch; returns the picture (SIZE, SIZE, 3).

        Args:
            truth_m: (k, 3) true positions up to the epoch.
            track_m: (k, 3) estimated positions up to the epoch.
            P: (2, 2) horizontal covariance of the last estimate, m^2.
            modes: (k,) number of the mode that ran in each epoch; it colors the track.
            accepted, rejected: (groups,) links first.
        """
        pygame, canvas = self._pygame, self._canvas
        canvas.fill(_PAPER)
        colors = [_MODES[mode % len(_MODES)] for mode in modes]
        here = self._pixels(truth_m[-1:])[0]
        for a, anchor in enumerate(self._pixels(self._anchors)):
            if accepted[a] or rejected[a]:
                pygame.draw.aaline(canvas, _ACCEPTED if accepted[a] else _REJECTED, here, anchor)
            pygame.draw.circle(canvas, _INK, anchor, 6 if a == 0 else 4, 0 if a == 0 else 1)
        if len(track_m) > 1:
            pygame.draw.aalines(canvas, _FAINT, False, self._pixels(truth_m))
            track = self._pixels(track_m)
            for start, end, color in zip(track, track[1:], colors[1:], strict=False):
                pygame.draw.aaline(canvas, color, start, end)
        pygame.draw.circle(canvas, _TRUTH, here, 4)
        pygame.draw.aalines(canvas, colors[-1], True, self._ellipse(track_m[-1, :2], P))
        error = float(np.linalg.norm(track_m[-1] - truth_m[-1]))
        text = f"epoch {len(track_m)}   {self._modes[modes[-1]]}   error {error:.1f} m"
        canvas.blit(self._font.render(text, True, _INK), (8, 8))
        if self._window is not None:
            self._window.blit(canvas, (0, 0))
            pygame.event.pump()
            pygame.display.flip()
            self._clock.tick(FRAMES_PER_SECOND)
        picture: NDArray[np.uint8] = np.transpose(pygame.surfarray.array3d(canvas), (1, 0, 2))
        return picture

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None

    def _pixels(self, points_m: Array) -> list[tuple[float, float]]:
        offset = (points_m[:, :2] - self._center) * self._pixels_per_m
        return [(SIZE / 2 + x, SIZE / 2 - y) for x, y in offset]

    def _ellipse(self, center_m: Array, P: Array) -> list[tuple[float, float]]:
        """95 % region of the horizontal position."""
        angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        shape = np.linalg.cholesky(P + 1e-9 * np.eye(2))
        return self._pixels(center_m + np.sqrt(_ELLIPSE_95) * circle @ shape.T)


def blank_picture() -> NDArray[np.uint8]:
    """What there is to see before the first epoch has been processed."""
    return np.full((SIZE, SIZE, 3), _PAPER, np.uint8)
