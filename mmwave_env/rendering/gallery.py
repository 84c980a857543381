"""Pictures of the first environments of a vector environment, for Gymnasium's vector wrappers."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Index
from mmwave_env.rendering.history import NO_MODE, History
from mmwave_env.rendering.theme import Pixels

DRAWN = 16  # maximum number of pictures; more would be too small to read and need much memory


@dataclass(eq=False)
class Gallery:
    """Recorder and painter of n environments, or only of the first :data:`DRAWN` if n is larger.

    Args:
        n: number of environments.
        rows: by name, the slices of a workspace (the array of all numbers of an environment) that
            contain ``anchors``, ``truth``, ``estimate``, ``P`` (of the position, packed),
            ``accepted`` and ``rejected``, and the indices of ``nees`` and ``dt`` (seconds until
            the next epoch).
        axes: number of position axes that NEES covers.
        modes, size, theme: same as for :func:`~mmwave_env.rendering.picture.draw_picture`.
    """

    n: int
    rows: Mapping[str, Any]
    axes: int
    modes: Sequence[str]
    size: int
    theme: str
    # by the environment's index: the episode's name and scene, and values of its epochs
    _recorded: dict[int, tuple[str, Scene | None, list[dict[str, Any]]]] = field(
        default_factory=dict
    )
    _window: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, without the window, which can't be copied."""
        return vars(self) | {"_window": None}

    def begin(
        self,
        indices: Index,
        names: Sequence[str],
        scene: Callable[[int], Scene | None],
        workspace: Callable[[int], Array],
    ) -> None:
        """Begin new recordings of some environments, whose workspaces contain the prior.

        ``names`` (n,) are the names of the episodes. Given an environment's index, ``scene``
        returns the scene of its episode; ``workspace`` returns its state, an array (size,).
        """
        for index in indices[indices < DRAWN].tolist():
            self._recorded[index] = names[index], scene(index), []
        self.add(indices, np.full(self.n, NO_MODE), workspace)

    def add(self, indices: Index, actions: NDArray[Any], workspace: Callable[[int], Array]) -> None:
        """Record the epoch that some environments just processed with their ``actions`` (n,)."""
        for index in indices[indices < DRAWN].tolist():
            numbers = workspace(index)
            values = {key: numbers[rows].copy() for key, rows in self.rows.items()}
            *_, epochs = self._recorded[index]
            epochs.append(values | {"modes": int(actions[index])})

    def history(self, index: int) -> History:
        """Return all epochs so far of an environment, whose first epoch is the prior."""
        name, scene, epochs = self._recorded[index]
        part = {key: np.array([epoch[key] for epoch in epochs]) for key in epochs[0]}
        part["nees"][0] = np.nan  # the workspace still has the previous episode's NEES
        for gate in ("accepted", "rejected"):
            part[gate] = part[gate] > 0.5
        anchors_m = part.pop("anchors")[0].reshape(-1, 3)
        time_s = np.cumsum(np.append(0.0, part.pop("dt")[:-1]))
        return History(name, anchors_m, scene, self.axes, time_s, **part)

    def draw(self) -> tuple[Pixels, ...]:
        """Draw n pictures, one per environment; pictures after the first DRAWN are black."""
        from mmwave_env.rendering.picture import draw_picture  # needs pygame

        drawn = [
            draw_picture(self.history(index), self.modes, self.size, self.theme)
            for index in self._recorded
        ]
        drawn += [np.zeros_like(drawn[0])] * (self.n - len(drawn))
        return tuple(drawn)

    def show(self, picture: Pixels) -> None:
        """Show a picture in a window, which opens with the first picture."""
        if self._window is None:
            from mmwave_env.rendering.window import Window

            self._window = Window(*picture.shape[:2])
        self._window.show(picture)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
