"""Measured tracks: a log with its truth, played as it was measured.

Nothing is measured anew: a seed draws where in the log an episode begins, if that is left open, and
the prior.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.datasets.tracks import Track, fields_of, numbers
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrack(Track):
    """T epochs of one user as a receiver measured them, and the truth.

    :meth:`from_arrays` makes one of what a user has; so does
    :func:`~mmwave_env.datasets.log_folder.read_log_folder`.

    Attributes:
        snr_db: (T, L); -inf where no SNR was measured.
        doppler_spread_hz: (T,).
    """

    snr_db: Array
    doppler_spread_hz: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        self.warn_of_contradictions()

    def _more_shapes(self, T: int, L: int) -> dict[str, tuple[int, ...]]:
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
        """A track from what a user has; NaN is what was not measured or is not known.

        A link with only some of its numbers counts as not measured. Angles are in the frame of
        the map: arrival is the direction anchor -> user, azimuth ``atan2(dy, dx)`` and elevation
        ``atan2(dz, hypot(dx, dy))``; departure is the azimuth user -> anchor. A virtual anchor's
        are as seen from the mirror image. docs/data.md, "Angles", converts others.

        Args:
            time_s: (T,) of the epochs, increasing, s.
            anchors_m: (L, 3) base station, then virtual anchors, m.
            range_m: (T, L) of links: speed of light times time of flight, one way, m.
            aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad: (T, L) of links, rad.
            snr_db: (T, L) of links, dB; noise follows from it and the radio profile.
            position_m: (T, 3) truth, m.
            doppler_hz: (T,) shift of the base station's link, positive while the range grows.
            doppler_spread_hz: (T,); 0 where there is none.
            velocity_mps: (T, 3) truth, m/s; None for differences of positions.
            carrier_hz, bandwidth_hz: of the signal.
            name: for results and messages.

        Raises:
            ValueError: an array of another shape, or times that do not increase; the message
                names it.
        """
        record = f"{cls.KIND} {name!r}"
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        fields, snr = fields_of(
            record, name, time_s, anchors_m, links, doppler_hz, ("snr_db", snr_db), position_m,
            velocity_mps, carrier_hz, bandwidth_hz,
        )  # fmt: skip
        T = len(snr)
        spread = np.zeros(T) if doppler_spread_hz is None else doppler_spread_hz
        return cls(
            **fields,
            snr_db=np.where(np.isnan(snr), -np.inf, snr),
            doppler_spread_hz=np.nan_to_num(numbers(record, "doppler_spread_hz", spread, (T,))),
        )

    def episode(
        self, radio: str | Radio, rng: np.random.Generator, epochs: slice = slice(None)
    ) -> Episode:
        """As :meth:`Track.episode`; only the prior is drawn, around the true state.

        The oscillator's true bias is not known, so its mean is 0.
        """
        measured, snr = self.measurement[epochs], self.snr_db[epochs]
        spread = self.doppler_spread_hz[epochs]
        found = self._played(radio_from(radio), rng, epochs, measured, snr, spread, 0.0)
        found.prior_mean[6] = 0.0
        return found
