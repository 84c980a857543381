"""Recordings: one track through a known scene, with measurements drawn anew in every episode.

A ray tracer (or a survey) gives the paths and what a perfect receiver would measure on them. A
seed adds the effects of the receiver from a radio profile: noise, the oscillator's bias and the
prior. Blockage, multipath, missed detections and outages are not simulated in addition, because
the recording already has the paths that exist.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.datasets.tracks import Track, fields_of
from mmwave_env.models.measurement import range_rate, wrap_angles
from mmwave_env.models.radio import Radio, doppler_spread, oscillator_bias, radio_from
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.checks import refuse, require_finite
from mmwave_env.world.episode import Episode

_NO_PATH_DB = -200.0  # gain of a missing path: negligible, but its sigmas stay finite


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording(Track):
    """T epochs of one user, as a perfect receiver would measure them.

    Attributes:
        path_gain_db: (T, L) gain of every link, negative; it has no meaning where not visible.
    """

    KIND: ClassVar[str] = "recording"

    path_gain_db: Array

    def __post_init__(self) -> None:
        super().__post_init__()
        require_finite(self.record, self, ("time_s", "position_m", "velocity_mps"))
        heard = self.path_gain_db[self.visible[:, : self.layout.anchors]]
        for field, values in (
            ("measurement", self.measurement[np.repeat(self.visible, self.layout.widths, axis=1)]),
            ("path_gain_db", heard),
        ):
            if not np.isfinite(values).all():
                refuse(self.record, field, "NaN or infinity where visible", "finite numbers")

    def _more_shapes(self, T: int, L: int) -> dict[str, tuple[int, ...]]:
        return {"path_gain_db": (T, L)}

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
        """Return a recording from the paths of a ray tracer or survey; NaN where there is no path.

        Arguments are those of :meth:`~mmwave_env.datasets.measured.MeasuredTrack.from_arrays`,
        exact, and ``path_gain_db``, (T, L) negative, which the radio profile turns into an SNR. The
        Doppler shift is computed from the true velocity wherever there is a line of sight.

        Raises:
            ValueError: an array has another shape, or its numbers are invalid; the message
                names the array.
        """
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        fields, gain = fields_of(
            f"{cls.KIND} {name!r}", name, time_s, anchors_m, links, None,
            ("path_gain_db", path_gain_db), position_m, velocity_mps, carrier_hz, bandwidth_hz,
        )  # fmt: skip
        found = cls(**fields, path_gain_db=gain)
        layout, away = found.layout, found.position_m - found.anchors_m[0]
        rate = range_rate(list(away.T), list(found.velocity_mps.T))
        found.measurement[:, layout.doppler] = found.scene.hz_per_mps * rate
        found.visible[:, layout.anchors] = found.visible[:, 0]
        found.warn_of_contradictions()
        return found

    def episode(
        self, radio: str | Radio, rng: np.random.Generator, epochs: slice = slice(None)
    ) -> Episode:
        """Return an episode as :meth:`Track.episode`; noise, bias, spread and prior are drawn."""
        profile, scene, layout = radio_from(radio), self.scene, self.layout
        gain = np.where(
            self.visible[epochs, : layout.anchors], self.path_gain_db[epochs], _NO_PATH_DB
        )
        snr = profile.snr_db(gain, scene.bandwidth_hz)
        sigma = profile.sigma(snr, scene, layout)
        measurement = self.measurement[epochs] + sigma * rng.standard_normal(sigma.shape)
        bias = oscillator_bias(profile, scene.hz_per_mps, self.time_s[epochs], rng)
        measurement[:, layout.doppler] += bias
        wrap_angles(measurement, layout)
        speed = np.linalg.norm(self.velocity_mps[epochs], axis=1)
        spread_hz = doppler_spread(profile, scene.hz_per_mps, speed, rng)
        return self._played(profile, rng, epochs, measurement, snr, spread_hz, bias[0])
