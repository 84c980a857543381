"""Measured tracks: logs with the true positions of the user, replayed as they were measured.

Measurements are the same in every episode. A seed determines only the prior and, if episodes are
shorter than the log, the epoch of the log at which an episode begins.
"""

from dataclasses import dataclass

import numpy as np

from mmwave_env.datasets.tracks import Received, Track
from mmwave_env.models.radio import Radio
from mmwave_env.numerics.numbers import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrack(Track):
    """T epochs of one user with measurements of a real receiver, and with the true positions.

    :func:`~mmwave_env.datasets.log_folder.read_log_folder` reads one from files.

    Attributes:
        snr_db: (T, L) SNR of every link; -inf where no SNR was measured.
        doppler_spread_hz: (T,) Doppler spread.
    """

    snr_db: Array
    doppler_spread_hz: Array

    def _received(self, radio: Radio, rng: np.random.Generator, epochs: slice) -> Received:
        spread = self.doppler_spread_hz[epochs]
        return Received(self.measurement[epochs], self.snr_db[epochs], spread, None)
