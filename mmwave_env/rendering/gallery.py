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


@dataclass
class Recorder:
    """A recorder that copies epochs from a workspace, the array of all numbers of an environment.

    The first epoch to record is the prior.

    Attributes:
        rows: by name, the slices of the workspace that contain ``anchors``, ``truth``,
            ``estimate``, ``P`` (of the position, packed), ``accepted`` and ``rejected``, and the
            indices of ``nees`` and ``dt`` (seconds until the next epoch).
        axes: number of position axes that NEES covers.
        name: name of the episode.
        scene: scene whose streets and walls the map shows; None if unknown.
        epochs: the recorded values, and the mode of each epoch as ``modes``.
    """

    rows: Mapping[str, Any]
    axes: int
    name: str
    scene: Scene | None
    epochs: list[dict[str, Any]] = field(default_factory=list)

    def add(self, workspace: Array, mode: int) -> None:
        """Record the epoch that a mode just processed."""
        values = {key: workspace[rows].copy() for key, rows in self.rows.items()}
        self.epochs.append(values | {"modes": mode})

    @property
    def history(self) -> History:
        """Return all epochs so far."""
        part = {key: np.array([epoch[key] for epoch in self.epochs]) for key in self.epochs[0]}
        part["nees"][0] = np.nan  # the workspace still has the previous episode's NEES
        for gate in ("accepted", "rejected"):
            part[gate] = part[gate] > 0.5
        anchors_m = part.pop("anchors")[0].reshape(-1, 3)
        time_s = np.cumsum(np.append(0.0, part.pop("dt")[:-1]))
        return History(self.name, anchors_m, self.scene, self.axes, time_s, **part)


class Gallery:
    """Recorder and painter of n environments, or only of the first :data:`DRAWN` if n is larger.

    :class:`Recorder` and :func:`~mmwave_env.rendering.picture.draw_picture` describe the arguments.
    """

    def __init__(
        self,
        n: int,
        rows: Mapping[str, Any],
        axes: int,
        modes: Sequence[str],
        size: int,
        theme: str,
    ) -> None:
        self._n = n
        self._recorded = (rows, axes)
        self._drawn_by = (modes, size, theme)
        self.recorders: dict[int, Recorder] = {}  # by the environment's index
        self._window: Any = None

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
            self.recorders[index] = Recorder(*self._recorded, names[index], scene(index))
            self.recorders[index].add(workspace(index), NO_MODE)

    def add(self, indices: Index, actions: NDArray[Any], workspace: Callable[[int], Array]) -> None:
        """Record the epoch that some environments just processed with their ``actions`` (n,)."""
        for index in indices[indices < DRAWN].tolist():
            self.recorders[index].add(workspace(index), int(actions[index]))

    def draw(self) -> tuple[Pixels, ...]:
        """Draw n pictures, one per environment; pictures after the first DRAWN are black."""
        from mmwave_env.rendering.picture import draw_picture  # needs pygame

        drawn = [draw_picture(each.history, *self._drawn_by) for each in self.recorders.values()]
        drawn += [np.zeros_like(drawn[0])] * (self._n - len(drawn))
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
