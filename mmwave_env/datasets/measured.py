"""Measured episodes: a log with its truth, played as it was measured.

A :class:`MeasuredTrack` is what a receiver wrote down and where the user truly was.
:class:`MeasuredSource` makes episodes of it. Nothing is measured anew: a seed draws where in
the log an episode begins, if that is left open, and the prior.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.datasets.arrays import (
    link_rows,
    numbers,
    stretches,
    truth_of,
    warn_of_contradictions,
)
from mmwave_env.lookup import quoted
from mmwave_env.models.measurement import Layout, whole_groups
from mmwave_env.models.prior import GAP_S, draw_prior
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.models.scene import Scene, scene_of_anchors
from mmwave_env.numerics.arrays import Array, Mask
from mmwave_env.world.checks import refuse, require_epochs, require_name
from mmwave_env.world.episode import Episode


@dataclass(frozen=True, eq=False)
class MeasuredTrack:
    """T epochs of one user as a receiver measured them, and the truth.

    :meth:`from_arrays` makes one of what a user has; so does
    :func:`~mmwave_env.datasets.log_folder.read_log_folder`.

    Attributes:
        name: what it is, for results and messages.
        scene: whose anchors were measured.
        layout: rows and groups.
        time_s: (T,) increasing.
        measurement: (T, rows) in the order of ``layout``: m, rad, Hz, m/s.
        visible: (T, groups) bool; elsewhere numbers mean nothing.
        snr_db: (T, L); -inf where no SNR was measured.
        doppler_spread_hz: (T,).
        position_m: (T, 3) truth, NaN in epochs where it is not known.
        velocity_mps: (T, 3) truth, known where positions are.
    """

    name: str
    scene: Scene
    layout: Layout
    time_s: Array
    measurement: Array
    visible: Mask
    snr_db: Array
    doppler_spread_hz: Array
    position_m: Array
    velocity_mps: Array

    def __post_init__(self) -> None:
        T, L, groups = len(self.time_s), self.layout.anchors, len(self.layout.groups)
        shapes: dict[str, tuple[int, ...]] = {
            "time_s": (T,), "measurement": (T, self.layout.size), "visible": (T, groups),
            "snr_db": (T, L), "doppler_spread_hz": (T,), "position_m": (T, 3),
            "velocity_mps": (T, 3),
        }  # fmt: skip
        record = f"track {quoted(self.name)}"
        require_name(record, self.name)
        require_epochs(record, self, shapes)
        if len(self.scene.anchors_m) != L:
            refuse(record, "anchors", f"{len(self.scene.anchors_m)} in the scene", f"{L}")
        warn_of_contradictions(
            record, self.scene, self.layout, self.measurement, self.visible, self.position_m
        )

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
        record = f"track {name!r}"
        time, position, velocity = truth_of(record, time_s, position_m, velocity_mps)
        anchors = numbers(record, "anchors_m", anchors_m, (None, 3))
        T, layout, nothing = len(time), Layout(len(anchors)), np.full(len(time), np.nan)
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        rows = link_rows(record, layout, links, nothing if doppler_hz is None else doppler_hz, T)
        snr = numbers(record, "snr_db", snr_db, (T, layout.anchors))
        spread = nothing if doppler_spread_hz is None else doppler_spread_hz
        visible, _ = whole_groups(rows, np.isfinite(snr), layout)
        return cls(
            name=name,
            scene=scene_of_anchors(name, anchors, carrier_hz, bandwidth_hz),
            layout=layout,
            time_s=time,
            measurement=rows,
            visible=visible,
            snr_db=np.where(np.isnan(snr), -np.inf, snr),
            doppler_spread_hz=np.nan_to_num(numbers(record, "doppler_spread_hz", spread, (T,))),
            position_m=position,
            velocity_mps=velocity,
        )

    def __len__(self) -> int:
        return len(self.time_s)

    def episode(
        self, radio: str | Radio, rng: np.random.Generator, epochs: slice = slice(None)
    ) -> Episode:
        """An episode of the track, or of some of its epochs, in which the truth is known.

        Args:
            radio: profile of the receiver: standard deviations by SNR, and the prior.
            rng: draws the prior around the true position and velocity; the oscillator's true
                bias is not known, so its mean is 0.
            epochs: consecutive ones.

        Raises:
            ValueError: the truth of an epoch is not known.
        """
        profile, snr = radio_from(radio), self.snr_db[epochs]
        position, velocity = self.position_m[epochs], self.velocity_mps[epochs]
        state = np.concatenate([position[0], velocity[0], [0.0]])
        mean, covariance = draw_prior(state, profile, self.scene, rng)
        mean[6] = 0.0
        return Episode(
            name=self.name,
            scene_anchors_m=self.scene.anchors_m,
            hz_per_mps=self.scene.hz_per_mps,
            time_s=self.time_s[epochs],
            measurement=self.measurement[epochs],
            sigma=profile.sigma(snr, self.scene, self.layout),
            visible=self.visible[epochs],
            snr_db=snr,
            doppler_spread_hz=self.doppler_spread_hz[epochs],
            prior_mean=mean,
            prior_covariance=covariance,
            truth_position_m=position,
            truth_velocity_mps=velocity,
            layout=self.layout,
        )


class MeasuredSource:
    """Episodes of one measured track: the same measurements in each, the prior drawn anew.

    An episode lies within a *stretch*: consecutive epochs that all have a true position, no two
    of them more than ``GAP_S`` apart.

    Args:
        track: the measurements.
        radio: profile of the receiver, by name or itself: standard deviations, prior.
        epochs: length of an episode, a window drawn at random out of all stretches; None for
            the longest stretch as a whole.

    Raises:
        ValueError: no stretch, or none of that length.
    """

    def __init__(self, track: MeasuredTrack, radio: str | Radio, epochs: int | None = None) -> None:
        self.track, self.radio = track, radio_from(radio)
        runs = stretches(track.time_s, track.position_m)
        if not runs:
            step = float(np.median(np.diff(track.time_s))) if len(track) > 1 else 0.0
            if step > GAP_S:
                refuse(
                    f"track {track.name!r}", "time_s", f"epochs {step:.4g} s apart",
                    f"at most {GAP_S:g} s: are its times in seconds?",
                )  # fmt: skip
            raise ValueError(
                f"track {track.name!r}: found no two epochs in a row with a true position, "
                "expected some, which reward and metrics need (docs/own-log.md)"
            )
        longest = max(runs, key=lambda run: run.stop - run.start)
        most = longest.stop - longest.start
        if epochs is None and most < len(track):
            warnings.warn(
                f"track {track.name!r}: found {len(track)} epochs, some without a true position or "
                f"after a gap of more than {GAP_S:g} s; episodes are the longest stretch between "
                f"them, {most} epochs from {track.time_s[longest.start]:g} s on",
                stacklevel=2,
            )
        self.epochs = most if epochs is None else epochs
        if not 1 <= self.epochs <= most:
            raise ValueError(
                f"epochs: found {epochs}, expected 1 to {most}, the longest stretch of track "
                f"{track.name!r} with truth and without a gap of more than {GAP_S:g} s"
            )
        whole = [longest] if epochs is None else runs
        self._starts = np.concatenate(
            [np.arange(run.start, run.stop - self.epochs + 1) for run in whole]
        )

    @property
    def layout(self) -> Layout:
        """Rows of every episode's measurements."""
        return self.track.layout

    @property
    def name(self) -> str:
        """The track's."""
        return self.track.name

    @property
    def scene(self) -> Scene:
        """The track's."""
        return self.track.scene

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw one episode; all randomness comes from ``rng``."""
        start = int(rng.choice(self._starts))
        return self.track.episode(self.radio, rng, slice(start, start + self.epochs))
