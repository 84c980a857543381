"""An episode that is over, played again: several histories of it beside each other."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mmwave_env.rendering.history import History
from mmwave_env.rendering.picture import Picture, legend_rows

_GAP_SHARE = 1 / 120  # of a picture's width, or two maps would look like one


class Playback:
    """Pictures of the same epoch, beside each other.

    Args:
        histories: of one episode, of as many epochs each.
        modes: what the actions are called in each of them.
        titles: above each of them.
        size, theme: of each picture, as of :class:`~mmwave_env.rendering.picture.Picture`.
    """

    def __init__(
        self,
        histories: Sequence[History],
        modes: Sequence[Sequence[str]],
        titles: Sequence[str],
        size: int,
        theme: str,
    ) -> None:
        rows = max(legend_rows(len(names)) for names in modes)  # strips at one height
        pictures = [
            Picture(names, size, theme, title, rows)
            for names, title in zip(modes, titles, strict=True)
        ]
        self._parts = list(zip(histories, pictures, strict=True))

    def draw(self, epochs: int) -> NDArray[np.uint8]:
        """All after so many epochs, (size, size of each added up, 3)."""
        known = [history.until(epochs) for history, _ in self._parts]
        drawn = [
            picture.draw(history, known)
            for history, (_, picture) in zip(known, self._parts, strict=True)
        ]
        for picture in drawn[1:]:
            picture[:, : round(_GAP_SHARE * len(picture))] = picture[0, 0]
        return np.concatenate(drawn, axis=1)
