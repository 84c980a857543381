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
from mmwave_env.logs.truth import velocity_of
from mmwave_env.models.layout import LINK, Layout, whole_groups, wrap_angles
from mmwave_env.models.measurement import range_rate
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio, doppler_spread, oscillator_bias
from mmwave_env.models.scene import scene_of_anchors
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.checks import refuse, require_increasing

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

        Times (T,) increase; anchors (L, 3) begin with the base station; values of paths are (T, L),
        gains are negative; true positions and velocities, by default their slopes, are (T, 3).
        docs/data.md, "Angles", defines angles. The Doppler shift comes from the true velocity.

        Raises:
            ValueError: an array has a wrong shape or invalid values; the message names the array.
        """
        record = f"{cls.KIND} {name!r}"
        time = _numbers(record, "time_s", time_s, (None,))
        require_increasing(record, time)
        T = len(time)
        anchors = _numbers(record, "anchors_m", anchors_m, (None, 3))
        layout = Layout(len(anchors))
        scene = scene_of_anchors(name, anchors, carrier_hz, bandwidth_hz)
        position = _numbers(record, "position_m", position_m, (T, 3))
        if velocity_mps is None:
            velocity = velocity_of(time, position, GAP_S)
        else:
            velocity = _numbers(record, "velocity_mps", velocity_mps, (T, 3))
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        rows = np.empty((T, layout.size))
        for i, (link, values) in enumerate(zip(LINK, links, strict=True)):
            rows[:, i : layout.doppler : 4] = _numbers(record, link, values, (T, layout.anchors))
        away = position - anchors[0]
        rows[:, layout.doppler] = scene.hz_per_mps * range_rate(list(away.T), list(velocity.T))
        wrap_angles(rows, layout)
        gain = _numbers(record, "path_gain_db", path_gain_db, (T, layout.anchors))
        visible, _ = whole_groups(rows, np.isfinite(gain), layout)
        visible[:, layout.anchors] = visible[:, 0]
        return cls(
            name=name,
            scene=scene,
            layout=layout,
            time_s=time,
            measurement=rows,
            visible=visible,
            position_m=position,
            velocity_mps=velocity,
            path_gain_db=gain,
        )

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


def _numbers(record: str, field: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return a new array of ``values``, refused unless it has this shape (None: any length > 0)."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError) as error:
        refuse(record, field, f"{type(values).__name__} ({error})", "an array of numbers")
    wanted = [n or max(m, 1) for n, m in zip(shape, array.shape, strict=False)]
    if array.ndim != len(shape) or list(array.shape) != wanted:
        refuse(record, field, f"shape {array.shape}", f"shape {shape}".replace("None", "any"))
    return array
