"""Measured tracks: a log with its truth, replayed as it was measured.

Measurements are never drawn anew: a seed draws the prior and, unless it is fixed, the epoch of
the log at which an episode begins.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.datasets.tracks import Received, Track, numbers
from mmwave_env.models.radio import Radio
from mmwave_env.numerics.numbers import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrack(Track):
    """T epochs of one user as a receiver measured them, with the truth.

    :meth:`from_arrays` makes a track of a user's arrays;
    :func:`~mmwave_env.datasets.log_folder.read_log_folder` reads it from files.

    Attributes:
        snr_db: (T, L); -inf where no SNR was measured.
        doppler_spread_hz: (T,) Doppler spread.
    """

    snr_db: Array
    doppler_spread_hz: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        self.warn_of_contradictions()

    def _own_shapes(self, T: int, L: int) -> dict[str, tuple[int, ...]]:
        return {"snr_db": (T, L), "doppler_spread_hz": (T,)}

    @classmethod
    def from_arrays(
        cls,
        *,
        time_s: ArrayLike,
        anchors_m: ArrayLike,
        range_m: ArrayLike,
        aoa_azimuth_rad: ArrayLike,
        aoa_elevation_rad: ArrayLike,
        aod_azimuth_rad: ArrayLike,
        snr_db: ArrayLike,
        position_m: ArrayLike,
        doppler_hz: ArrayLike | None = None,
        doppler_spread_hz: ArrayLike | None = None,
        velocity_mps: ArrayLike | None = None,
        carrier_hz: float = 28e9,
        bandwidth_hz: float = 100e6,
        name: str = "own",
    ) -> "MeasuredTrack":
        """Return a track from a user's arrays; NaN stands for what was not measured or is unknown.

        A link with only some of its numbers counts as not measured. Angles are in the frame of
        the map: arrival is the direction anchor -> user, azimuth ``atan2(dy, dx)`` and elevation
        ``atan2(dz, hypot(dx, dy))``; departure is the azimuth user -> anchor. Angles of a virtual
        anchor are seen from the mirror image. docs/data.md, "Angles", converts other conventions.

        Args:
            time_s: (T,) times of the epochs, increasing, s.
            anchors_m: (L, 3) base station, then virtual anchors, m.
            range_m: (T, L) ranges of links: speed of light times one-way time of flight, m.
            aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad: (T, L) angles of links, rad.
            snr_db: (T, L) SNR of links, dB; with the radio profile it determines the noise.
            position_m: (T, 3) true positions, m.
            doppler_hz: (T,) shift of the base station's link, positive while the range grows.
            doppler_spread_hz: (T,) Doppler spread; 0 where there is none.
            velocity_mps: (T, 3) true velocities, m/s; None for differences of positions.
            carrier_hz, bandwidth_hz: frequencies of the signal.
            name: name for results and messages.

        Raises:
            ValueError: an array has another shape, or times do not increase; the message
                names the array.
        """
        record = f"{cls.KIND} {name!r}"
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        strength, signal = ("snr_db", snr_db), (carrier_hz, bandwidth_hz)
        fields, snr = cls._fields(
            name, time_s, anchors_m, links, strength, (position_m, velocity_mps), signal, doppler_hz
        )
        spread = np.zeros(len(snr)) if doppler_spread_hz is None else doppler_spread_hz
        return cls(
            **fields,
            snr_db=np.where(np.isnan(snr), -np.inf, snr),
            doppler_spread_hz=np.nan_to_num(
                numbers(record, "doppler_spread_hz", spread, (len(snr),))
            ),
        )

    def _received(self, radio: Radio, rng: np.random.Generator, epochs: slice) -> Received:
        snr, spread = self.snr_db[epochs], self.doppler_spread_hz[epochs]
        return Received(self.measurement[epochs], snr, spread, bias_hz=None)
