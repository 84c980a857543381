"""The paths of a scenario, whichever files they were read from: in SI units, in the files' meaning.

:mod:`mmwave_env.datasets.deepmimo.anchors` makes sense of them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from mmwave_env.numerics.arrays import Array, Mask
from mmwave_env.world.checks import refuse_in

TOLERANCE_M = 0.05  # float32 files agree to 1e-4 m; places closer than this are one
# Values of ``interactions``: a digit for each interaction, from the base station to the receiver.
LINE_OF_SIGHT, REFLECTION = 0.0, 1.0


@dataclass(frozen=True, eq=False)
class StationPaths:
    """The paths between one base station and E receivers, at most P for each.

    Paths with ``interactions`` 0 or 1 have finite numbers everywhere (a bounce where there is
    one); those of others mean nothing.

    Attributes:
        name: which station it is, in the words of the files.
        position_m: (3,) of the station.
        interactions: (E, P) 0 line of sight, 1 one reflection, ...; NaN where there is no path.
        bounce_m: (E, P, 3) first point of interaction.
        gain_db: (E, P) 20 log10 |a|.
        delay_s: (E, P) absolute.
        arrival, departure: (E, P, 2) azimuth and zenith angle at the receiver and at the station,
            rad; whether along propagation or against it, lines of sight tell.
        source: the file, and the receiver's number in it, that a key of an epoch was read from.
    """

    name: str
    position_m: Array
    interactions: Array
    bounce_m: Array
    gain_db: Array
    delay_s: Array
    arrival: Array
    departure: Array
    source: Callable[[str, int], tuple[Path, int]]

    def refuse(self, key: str, epoch: int, found: str, expected: str) -> NoReturn:
        """Raise a ValueError about what a file says of a receiver."""
        file, receiver = self.source(key, epoch)
        refuse_in(file, key, f"{found} of receiver {receiver}", expected)


@dataclass(frozen=True, eq=False)
class Paths:
    """The paths of E receivers, which become the epochs of one track.

    Attributes:
        name: of the scenario, for results and messages.
        carrier_hz: carrier frequency.
        position_m: (E, 3) of the receivers.
        stations: one at least.
    """

    name: str
    carrier_hz: float
    position_m: Array
    stations: tuple[StationPaths, ...]


def propagation(angles: Array, sight: Array, direct: Mask) -> Array:
    """Unit vectors (E, P, 3) along propagation, from azimuths and zenith angles (E, P, 2).

    Some converters store directions along propagation, some against it; lines of sight tell.
    """
    azimuth, zenith = np.moveaxis(angles, -1, 0)
    horizontal = np.sin(zenith)
    unit = np.stack(
        [horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.cos(zenith)], axis=-1
    )
    along = np.sum(unit * sight, axis=-1)[direct]
    return unit if np.median(along) > 0.0 else -unit
