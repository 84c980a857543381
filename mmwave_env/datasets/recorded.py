"""Recorded episodes: one track through a known scene, measured anew at every draw.

A ray tracer (or a survey) says which paths exist and what a perfect receiver would read
there. A :class:`Recording` holds that; :class:`RecordedSource` adds what a radio profile
says about the receiver: noise, the oscillator's bias and the prior. Blockage, multipath,
missed detections and outages are not simulated on top, because the recording knows which
paths there are.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mmwave_env.datasets.arrays import (
    link_rows,
    numbers,
    truth_of,
    warn_of_contradictions,
)
from mmwave_env.lookup import quoted
from mmwave_env.models.measurement import (
    Layout,
    range_rate,
    whole_groups,
    wrap_angles,
)
from mmwave_env.models.prior import draw_prior
from mmwave_env.models.radio import Radio, doppler_spread, oscillator_bias, radio_from
from mmwave_env.models.scene import Scene, scene_of_anchors
from mmwave_env.numerics.arrays import Array
from mmwave_env.world.checks import refuse, require_epochs, require_finite, require_name
from mmwave_env.world.episode import Episode

_NO_PATH_DB = -200.0  # gain of a missing path: as good as none, yet its sigmas stay finite


@dataclass(frozen=True, eq=False)
class Recording:
    """T epochs of one user, as a perfect receiver would measure them.

    Where ``visible`` is False (for gains: where the link is not visible) numbers mean nothing.

    Attributes:
        name: what it is, for results and messages.
        anchors_m: (L, 3) the physical gNB first, then virtual anchors.
        carrier_hz: carrier frequency f_c.
        bandwidth_hz: signal bandwidth B, for the receiver's noise.
        time_s: (T,) increasing.
        measurement: (T, rows) exact, in the order of ``layout``: m, rad, Hz, m/s.
        visible: (T, groups) bool.
        path_gain_db: (T, L) of every link, negative.
        position_m: (T, 3) truth.
        velocity_mps: (T, 3) truth.
        layout: rows and groups.
    """

    name: str
    anchors_m: Array
    carrier_hz: float
    bandwidth_hz: float
    time_s: Array
    measurement: Array
    visible: NDArray[np.bool_]
    path_gain_db: Array
    position_m: Array
    velocity_mps: Array
    layout: Layout

    def __post_init__(self) -> None:
        T, L = len(self.time_s), self.layout.anchors
        groups = self.layout.groups
        shapes: dict[str, tuple[int, ...]] = {
            "anchors_m": (L, 3), "time_s": (T,), "measurement": (T, self.layout.size),
            "visible": (T, len(groups)), "path_gain_db": (T, L), "position_m": (T, 3),
            "velocity_mps": (T, 3),
        }  # fmt: skip
        record = f"recording {quoted(self.name)}"
        require_name(record, self.name)
        require_epochs(record, self, shapes)
        require_finite(record, self, ("anchors_m", "time_s", "position_m", "velocity_mps"))
        widths = [rows.stop - rows.start for rows in groups]
        if not np.isfinite(self.measurement[np.repeat(self.visible, widths, axis=1)]).all():
            refuse(record, "measurement", "NaN or infinity in a visible group", "finite numbers")
        if not np.isfinite(self.path_gain_db[self.visible[:, :L]]).all():
            refuse(record, "path_gain_db", "NaN or infinity on a visible link", "finite numbers")
        for field in ("carrier_hz", "bandwidth_hz"):
            if not 0.0 < getattr(self, field) < np.inf:
                refuse(record, field, f"{getattr(self, field)}", "> 0")

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
        """A recording from the paths of a ray tracer or a survey; NaN where there is no path.

        Angles are as of :meth:`~mmwave_env.datasets.measured.MeasuredTrack.from_arrays`. The
        Doppler shift is that of the true velocity, wherever there is a line of sight.

        Args:
            time_s: (T,) of the epochs, increasing, s.
            anchors_m: (L, 3) base station, then virtual anchors, m.
            range_m: (T, L) exact lengths of the paths, m.
            aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad: (T, L) exact, rad.
            path_gain_db: (T, L) negative, dB; the radio profile makes it an SNR.
            position_m: (T, 3) truth, m.
            velocity_mps: (T, 3) truth, m/s; None for differences of positions.
            carrier_hz, bandwidth_hz: of the signal.
            name: for results and messages.

        Raises:
            ValueError: an array of another shape, or numbers that mean nothing; the message
                names it.
        """
        record = f"recording {name!r}"
        time, position, velocity = truth_of(record, time_s, position_m, velocity_mps)
        anchors = numbers(record, "anchors_m", anchors_m, (None, 3))
        layout = Layout(len(anchors))
        scene = scene_of_anchors(name, anchors, carrier_hz, bandwidth_hz)
        rate = range_rate(list((position - anchors[0]).T), list(velocity.T))
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        rows = link_rows(record, layout, links, scene.hz_per_mps * rate, len(time))
        gain = numbers(record, "path_gain_db", path_gain_db, (len(time), layout.anchors))
        visible, _ = whole_groups(rows, np.isfinite(gain), layout)
        visible[:, layout.anchors] &= visible[:, 0]
        warn_of_contradictions(record, scene, layout, rows, visible, position)
        return cls(name, anchors, carrier_hz, bandwidth_hz, time, rows, visible, gain, position,
                   velocity, layout)  # fmt: skip

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def scene(self) -> Scene:
        """The anchors and the carrier; walls are not known."""
        return scene_of_anchors(self.name, self.anchors_m, self.carrier_hz, self.bandwidth_hz)

    def window(self, first: int, epochs: int) -> "Recording":
        """The recording of ``epochs`` epochs from epoch ``first`` on; times stay as they are."""
        cut = slice(first, first + epochs)
        return replace(
            self,
            time_s=self.time_s[cut],
            measurement=self.measurement[cut],
            visible=self.visible[cut],
            path_gain_db=self.path_gain_db[cut],
            position_m=self.position_m[cut],
            velocity_mps=self.velocity_mps[cut],
        )


class RecordedSource:
    """Episodes of one recording; every draw has its own noise, oscillator, prior and window.

    Args:
        recording: the exact measurements.
        radio: profile of the receiver, by name or itself: standard deviations, oscillator, prior.
        epochs: length of an episode, a contiguous window drawn at random; None for the whole
            recording.

    Raises:
        ValueError: a window longer than the recording or empty.
    """

    def __init__(self, recording: Recording, radio: str | Radio, epochs: int | None = None) -> None:
        self.recording, self.radio = recording, radio_from(radio)
        self.epochs = len(recording) if epochs is None else epochs
        if not 1 <= self.epochs <= len(recording):
            raise ValueError(
                f"epochs: found {epochs}, expected 1 to {len(recording)}, the length of "
                f"recording {recording.name!r}"
            )

    @property
    def layout(self) -> Layout:
        """Rows of every episode's measurements."""
        return self.recording.layout

    @property
    def name(self) -> str:
        """The recording's."""
        return self.recording.name

    @property
    def scene(self) -> Scene:
        """The recording's."""
        return self.recording.scene

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw one episode; all randomness comes from ``rng``."""
        starts = np.arange(len(self.recording) - self.epochs + 1)
        recording = self.recording.window(int(rng.choice(starts)), self.epochs)
        radio, scene, layout = self.radio, self.scene, self.layout
        seen = recording.visible[:, : layout.anchors]
        gain = np.where(seen, recording.path_gain_db, _NO_PATH_DB)
        snr = radio.snr_db(gain, recording.bandwidth_hz)
        sigma = radio.sigma(snr, scene, layout)
        measurement = recording.measurement.copy()
        measurement += sigma * rng.standard_normal(measurement.shape)
        bias = oscillator_bias(radio, scene.hz_per_mps, recording.time_s, rng)
        measurement[:, layout.doppler] += bias
        wrap_angles(measurement, layout)
        speed = np.linalg.norm(recording.velocity_mps, axis=1)
        spread_hz = doppler_spread(radio, scene.hz_per_mps, speed, rng)
        state = [recording.position_m[0], recording.velocity_mps[0], bias[:1]]
        mean, covariance = draw_prior(np.concatenate(state), radio, scene, rng)
        return Episode(
            name=recording.name,
            scene_anchors_m=recording.anchors_m,
            hz_per_mps=scene.hz_per_mps,
            time_s=recording.time_s,
            measurement=measurement,
            sigma=sigma,
            visible=recording.visible,
            snr_db=snr,
            doppler_spread_hz=spread_hz,
            prior_mean=mean,
            prior_covariance=covariance,
            truth_position_m=recording.position_m,
            truth_velocity_mps=recording.velocity_mps,
            layout=layout,
        )
