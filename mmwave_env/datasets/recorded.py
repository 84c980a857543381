"""Recordings: one track through a known scene, with measurements drawn anew in every episode.

A ray tracer (or a survey) gives the paths and what a perfect receiver would measure on them. Each
episode adds noise and an oscillator's bias, and it has its own prior. A seed and a radio profile
determine all three. Blockage, multipath, missed detections and outages are not simulated, because
the recording already says which paths exist.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.datasets.tracks import Received, Track
from mmwave_env.models.layout import wrap_angles
from mmwave_env.models.measurement import range_rate
from mmwave_env.models.radio import Radio, doppler_spread, oscillator_bias
from mmwave_env.numerics.numbers import Array

_NO_PATH_DB = -200.0  # gain of a missing path: so low that it is negligible, but not infinite


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording(Track):
    """T epochs of one user, with the measurements of a perfect receiver.

    Attributes:
        path_gain_db: (T, L) gain of every link, negative; meaningless if the link is not visible.
    """

    KIND: ClassVar[str] = "recording"

    path_gain_db: Array

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
        path_gain_db: ArrayLike,
        position_m: ArrayLike,
        velocity_mps: ArrayLike | None = None,
        carrier_hz: float = 28e9,
        bandwidth_hz: float = 100e6,
        name: str = "own",
    ) -> "Recording":
        """Return a recording of the paths of a ray tracer or survey; NaN stands for a missing path.

        Arguments are as in :meth:`~mmwave_env.datasets.measured.MeasuredTrack.from_arrays`, but
        measurements are exact. The radio profile converts ``path_gain_db`` (T, L), which is
        negative, to an SNR. Where there is a line of sight, the Doppler shift is computed from the
        true velocity.

        Raises:
            ValueError: an array has a wrong shape or invalid values; the message names the array.
        """
        fields, gain = cls._fields(
            name,
            time_s,
            anchors_m,
            (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad),
            ("path_gain_db", path_gain_db),
            (position_m, velocity_mps),
            (carrier_hz, bandwidth_hz),
        )
        recording = cls(**fields, path_gain_db=gain)
        layout = recording.layout
        away = recording.position_m - recording.anchors_m[0]
        rate = range_rate(list(away.T), list(recording.velocity_mps.T))
        recording.measurement[:, layout.doppler] = recording.scene.hz_per_mps * rate
        recording.visible[:, layout.anchors] = recording.visible[:, 0]
        return recording

    def _received(self, radio: Radio, rng: np.random.Generator, epochs: slice) -> Received:
        """Draw the noise, the oscillator's bias and the Doppler spread of some epochs."""
        scene = self.scene
        layout = self.layout
        links = self.visible[epochs, : layout.anchors]
        gain = np.where(links, self.path_gain_db[epochs], _NO_PATH_DB)
        snr = radio.snr_db(gain, scene.bandwidth_hz)
        sigma = radio.sigma(snr, scene, layout)
        measurement = self.measurement[epochs] + sigma * rng.standard_normal(sigma.shape)
        bias = oscillator_bias(radio, scene.hz_per_mps, self.time_s[epochs], rng)
        measurement[:, layout.doppler] += bias
        wrap_angles(measurement, layout)
        speed = np.linalg.norm(self.velocity_mps[epochs], axis=1)
        spread_hz = doppler_spread(radio, scene.hz_per_mps, speed, rng)
        return Received(measurement, snr, spread_hz, bias)
