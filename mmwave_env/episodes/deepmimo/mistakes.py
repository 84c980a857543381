"""Which mistake explains a path that contradicts where its ends are: a unit, or a convention.

It is named and never undone: a file that is wrong in one way may be wrong in another.
"""

from collections.abc import Callable

import numpy as np

from mmwave_env.episodes.deepmimo.paths import LINE_OF_SIGHT, StationPaths
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.numbers import PI

_CLOSE = 0.01  # of a distance; of 1 - cos of an angle
_TIMES = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "there-and-back": 0.5}
_ANGLES: dict[str, Callable[[Array, Array], tuple[Array, Array]]] = {  # azimuth, zenith angle
    "radians": lambda azimuth, zenith: (np.degrees(azimuth), np.degrees(zenith)),
    "elevations above the horizon": lambda azimuth, zenith: (azimuth, PI / 2 - zenith),
    "bearings clockwise from the y axis": lambda azimuth, zenith: (PI / 2 - azimuth, zenith),
}


def likely_mistake(paths: StationPaths, position_m: Array, key: str) -> str:
    """What the numbers of a key look like on lines of sight, such as "nanoseconds"; "" for none.

    Args:
        paths: with a line of sight somewhere.
        position_m: (E, 3) of the receivers.
        key: ``delay``, or one of ``aoa_az``, ``aoa_el``, ``aod_az``, ``aod_el``.
    """
    epoch, path = np.nonzero(paths.interactions == LINE_OF_SIGHT)
    sight = position_m[epoch] - paths.position_m
    distance = np.linalg.norm(sight, axis=1)
    if key == "delay":
        length = SPEED_OF_LIGHT * paths.delay_s[epoch, path]
        wrong = {name: abs(length * unit - distance) / distance for name, unit in _TIMES.items()}
    else:
        angles = paths.arrival if key.startswith("aoa") else paths.departure
        azimuth, zenith = angles[epoch, path].T
        along = {name: _cosine(*undo(azimuth, zenith), sight) for name, undo in _ANGLES.items()}
        wrong = {name: 1.0 - abs(np.median(cosine)) for name, cosine in along.items()}
    return next((name for name, error in wrong.items() if np.median(error) < _CLOSE), "")


def _cosine(azimuth: Array, zenith: Array, sight: Array) -> Array:
    """Cosines (M,) of the angles between directions and lines of sight (M, 3)."""
    level = np.sin(zenith)
    unit = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.cos(zenith)], axis=-1)
    return np.asarray(np.sum(unit * sight, axis=-1) / np.linalg.norm(sight, axis=-1))
