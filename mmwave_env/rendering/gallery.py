"""Pictures of the first few of many environments, as Gymnasium's vector wrappers take them."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mmwave_env.models.scene import Streets
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.rendering.history import Recorder

DRAWN = 16  # more would be too small to read, and too many for memory


class Gallery:
    """Writes down and draws the first few of N environments, at most :data:`DRAWN`.

    Args:
        n: N.
        recorders: of the environments that are drawn.
        modes, size, theme: as of :class:`~mmwave_env.rendering.picture.Picture`.
        workspace: of an environment, (size,).
    """

    def __init__(
        self,
        n: int,
        recorders: Sequence[Recorder],
        modes: Sequence[str],
        size: int,
        theme: str,
        workspace: Callable[[int], Array],
    ) -> None:
        from mmwave_env.rendering.picture import Picture

        self._n, self._workspace = n, workspace
        self._recorders = recorders
        self._picture = Picture(modes, size, theme)

    def begin(
        self, places: Index, names: Sequence[str], streets: Callable[[int], Streets | None]
    ) -> None:
        """Start over in some environments, with the prior that they are at.

        Args:
            places: the environments.
            names: (N,) of the episodes.
            streets: of the episode in one of the environments.
        """
        for place in self._drawn(places):
            self._recorders[place].begin(names[place], streets(place), self._workspace(place))

    def add(self, places: Index, actions: Index) -> None:
        """Write down the epoch just processed in some environments, by actions (N,)."""
        for place in self._drawn(places):
            self._recorders[place].add(self._workspace(place), int(actions[place]))

    def draw(self) -> tuple[NDArray[np.uint8], ...]:
        """A picture of each of the N environments; of those not drawn, the same empty one."""
        drawn = [self._picture.draw(recorder.history) for recorder in self._recorders]
        blank = self._picture.blank(f"{len(drawn)} of {self._n} environments are drawn")
        return (*drawn, *[blank] * (self._n - len(drawn)))

    def _drawn(self, places: Index) -> Iterable[int]:
        return (int(place) for place in places if place < len(self._recorders))
