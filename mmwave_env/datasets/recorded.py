"""Recorded data of one user over some epochs (a *track*), and the episodes drawn from them.

A track contains the measurements of a real receiver (:class:`MeasuredTrack`), or the paths of a ray
tracer or a survey (:class:`Recording`).
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.io.lookup import quoted
from mmwave_env.logs.log_tables import Arrays
from mmwave_env.logs.truth import stretches, velocity_of
from mmwave_env.models.layout import (
    LINK,
    Layout,
    measurements_from,
    offered_rows,
    whole_groups,
    wrap_angles,
)
from mmwave_env.models.measurement import exact_rows, range_rate
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio, clock_bias, doppler_spread, oscillator_bias, radio_from
from mmwave_env.models.scene import Scene, scene_of_anchors
from mmwave_env.numerics.numbers import Array, Index, Mask, wrap
from mmwave_env.world.episode import Episode, require_increasing

# Median errors of a link's range (m) and angles (rad). Medians above _FAR are warned of, medians
# below _NEAR are not; between them, the limit depends on the noise.
_FAR = (50.0, 0.5, 0.5, 0.5)
_NEAR = (5.0, 0.05, 0.05, 0.05)
_NOISE = 0.6745 * np.sqrt(2.0)  # median of the absolute difference of two N(0, 1) errors
_ENOUGH = 20  # minimum number of epochs for a median

Received = tuple[Array, Array, Array, Array | None]  # result of ``Track._received``


@dataclass(frozen=True, eq=False, kw_only=True)
class Track(Arrays, ABC):
    """T epochs of one user.

    Attributes:
        name: name for results and messages.
        scene: scene whose L anchors were measured; often only its anchors are known.
        layout: which value is in which row of a measurement, and which rows form a group.
        time_s: (T,) times, increasing.
        measurement: (T, rows) in the order of ``layout``: m, rad, Hz, m/s.
        visible: (T, groups) whether each group was measured; if not, its values are meaningless.
        position_m: (T, 3) true positions, NaN in epochs where unknown.
        velocity_mps: (T, 3) true velocities, NaN in epochs where unknown.
        sigma: (T, rows) the receiver's own standard deviations, NaN where it states none; None
            unless the layout is partial (single values may be missing).
        doppler_anchor: (T,) index, from 0, of the anchor whose Doppler shift was measured; None
            for the base station.
    """

    KIND: ClassVar[str] = "track"

    name: str
    scene: Scene
    layout: Layout
    time_s: Array
    measurement: Array
    visible: Mask
    position_m: Array
    velocity_mps: Array
    sigma: Array | None = None
    doppler_anchor: Index | None = None

    @abstractmethod
    def _received(self, radio: Radio, rng: np.random.Generator) -> Received:
        """Return what a receiver with this radio profile measures in the T epochs.

        The ranges of a receiver whose clock has an unknown offset contain the offset's bias.

        Returns:
            Measurements (T, rows), SNRs (T, L), Doppler spreads (T,), and the oscillator's bias
            (T,), Hz, or None if it is unknown.
        """

    def episode(self, radio: Radio, rng: np.random.Generator) -> Episode:
        """Return the epochs of the track as an episode, whose true positions are known.

        The prior is drawn around the true state. If the bias of the oscillator is unknown, the mean
        of its prior is 0. If the user's clock has an unknown offset, the ranges of a recording get
        a bias, drawn from a random stream of its own. A measured track's ranges already contain the
        bias of a real clock.

        Raises:
            ValueError: the true position in an epoch is not known.
        """
        measurement, snr_db, spread_hz, bias = self._received(radio, rng)
        bias_hz = 0.0 if bias is None else bias[0]
        state = np.concatenate([self.position_m[0], self.velocity_mps[0], [bias_hz]])
        covariance = radio.prior_covariance(self.scene, self.layout.clock)
        mean = np.zeros(len(covariance))
        mean[:7] = state + np.sqrt(np.diag(covariance)[:7]) * rng.standard_normal(7)
        if bias is None:
            mean[6] = 0.0
        return Episode.measured(
            self.scene,
            radio,
            self.layout,
            snr_db,
            name=self.name,
            time_s=self.time_s,
            measurement=measurement,
            visible=self.visible,
            doppler_spread_hz=spread_hz,
            prior_mean=mean,
            prior_covariance=covariance,
            sigma=self.sigma,
            doppler_anchor=self.doppler_anchor,
            truth_position_m=self.position_m,
            truth_velocity_mps=self.velocity_mps,
        )

    @property
    def record(self) -> str:
        """Return the kind and name of the track, for messages."""
        return f"{self.KIND} {quoted(self.name)}"

    @property
    def anchors_m(self) -> Array:
        """Return the anchors (L, 3): the base station first, then virtual anchors."""
        return self.scene.anchors_m

    def warn_of_contradictions(self) -> None:
        """Warn if the errors of links, computed with the true positions, have a large median.

        The cause is a wrong convention or unit, or a true track in another frame. Noise alone
        causes no warning: its size is estimated from the errors' changes between epochs.
        """
        layout = self.layout
        anchors = self.anchors_m.tolist()
        position = list(self.position_m.T)
        exact = exact_rows(position, [0.0] * 3, anchors, 0.0, Layout(layout.anchors))
        far = []
        for row in range(layout.doppler):
            a, i = divmod(row, len(LINK))
            error = (self.measurement[:, row] - exact[row])[self.visible[:, a]]
            error = error[np.isfinite(error)]  # where the true position is known
            if len(error) < _ENOUGH or (layout.has_bias and not i):
                continue  # a clock offset is no contradiction
            change = np.diff(error)
            if i:
                error = wrap(error)
                change = wrap(change)
            median = np.median(np.abs(error))
            # With noise alone, the median of |error| is about 0.67 standard deviations.
            noise = np.median(np.abs(change)) / _NOISE
            if median > min(_FAR[i], max(_NEAR[i], 2.0 * noise)):
                far.append(f"{LINK[i]} of anchor {a + 1}: {median:.3g}")
        if far:
            warnings.warn(
                f"{self.record}: found large median errors ({', '.join(far)}), expected "
                'units, angles and frame as docs/data.md ("Angles") defines them',
                stacklevel=2,
            )


class TrackSource:
    """Source of episodes from one track.

    An episode lies within a *stretch*: consecutive epochs that all have a true position and
    velocity, without a gap of more than ``GAP_S``.

    Args:
        track: a measured track, whose measurements are the same in each episode; or a recording
            of the channel, from which each episode draws new noisy measurements.
        radio: profile of the receiver, or its name.
        epochs: length of an episode; each episode is a window drawn at random from all stretches.
            None if each episode is the longest stretch, from beginning to end.
        measurements: names of the measurements to use; None for all.
        clock: state of the user's clock, one of :data:`~mmwave_env.models.layout.CLOCKS`.

    Raises:
        ValueError: no stretch has enough epochs; or the track lacks the ``measurements``, or the
            ranges that ``clock`` needs.
    """

    def __init__(
        self,
        track: Track,
        radio: str | Radio,
        epochs: int | None = None,
        measurements: Sequence[str] | None = None,
        clock: str = "synchronized",
    ) -> None:
        if clock != "synchronized":
            if not np.isfinite(track.measurement[:, track.layout.ranges]).any():
                raise ValueError(
                    f"clock of {track.record}: found {clock}, but no ranges, expected a track with "
                    "ranges"
                )
            partial = track.layout.partial or clock == "free"
            track = replace(track, layout=replace(track.layout, clock=clock, partial=partial))
        track.warn_of_contradictions()
        self.track = track
        self.radio = radio_from(radio)
        self.layout = track.layout
        self.name = track.name
        self.scene = track.scene
        self._measurements = measurements_from(measurements)
        if self._measurements:
            self.layout = layout = replace(self.layout, partial=True)
            rows = np.isfinite(track.measurement) & offered_rows(layout, self._measurements)
            if not rows[:, : layout.doppler].any():
                shown = ", ".join(self._measurements)
                raise ValueError(
                    f"measurements: found {shown}, expected a range or an angle of {track.record}"
                )
        truth = np.hstack([track.position_m, track.velocity_mps])
        runs = stretches(track.time_s, truth, GAP_S)
        if not runs:
            raise ValueError(
                f"{track.record}: found no two consecutive epochs at most {GAP_S:g} s apart "
                "with true positions, which the reward needs (docs/own-log.md). Are the track's "
                "times in seconds?"
            )
        longest = max(runs, key=lambda run: run.stop - run.start)
        most = longest.stop - longest.start
        if epochs is None and most < len(track):
            warnings.warn(
                f"{track.record}: found {len(track)} epochs, some without a true position or "
                f"after a gap of more than {GAP_S:g} s; episodes use the longest stretch without "
                f"these, {most} epochs from {track.time_s[longest.start]:.13g} s on",
                stacklevel=2,
            )
        self.epochs = most if epochs is None else epochs
        if not 1 <= self.epochs <= most:
            raise ValueError(
                f"episode_steps (epochs): found {epochs}, expected 1 to {most}, the length of the "
                f"longest stretch of {track.record} with true positions and without a gap of more "
                f"than {GAP_S:g} s"
            )
        whole = [longest] if epochs is None else runs
        self._starts = np.concatenate(
            [np.arange(run.start, run.stop - self.epochs + 1) for run in whole]
        )

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw an episode; all randomness comes from ``rng``."""
        start = int(rng.choice(self._starts))
        episode = self.track.part(slice(start, start + self.epochs)).episode(self.radio, rng)
        return episode.only(self._measurements) if self._measurements else episode


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrack(Track):
    """T epochs of one user with measurements of a real receiver, and with the true positions.

    Measurements are the same in every episode. A seed determines only the prior and, if episodes
    are shorter than the log, the epoch of the log at which an episode begins.
    :func:`~mmwave_env.datasets.log_folder.read_log_folder` reads one from files.

    Attributes:
        snr_db: (T, L) SNR of every link; -inf where no SNR was measured.
        doppler_spread_hz: (T,) Doppler spread.
    """

    snr_db: Array
    doppler_spread_hz: Array

    def _received(self, radio: Radio, rng: np.random.Generator) -> Received:
        return self.measurement, self.snr_db, self.doppler_spread_hz, None


_NO_PATH_DB = -200.0  # gain of a missing path: so low that it is negligible, but not infinite


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording(Track):
    """T epochs of one user, with the measurements of a perfect receiver on known paths.

    Each episode adds noise and an oscillator's bias, and it has its own prior. A seed and a radio
    profile determine all three. Blockage, multipath, missed detections and outages are not
    simulated, because the recording already says which paths exist.

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
        visible = whole_groups(np.isfinite(rows), np.isfinite(gain), layout)
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

    def _received(self, radio: Radio, rng: np.random.Generator) -> Received:
        """Draw the noise, the oscillator's bias and the Doppler spread."""
        scene = self.scene
        layout = self.layout
        gain = np.where(self.visible[:, : layout.anchors], self.path_gain_db, _NO_PATH_DB)
        snr = radio.snr_db(gain, scene.bandwidth_hz)
        sigma = radio.sigma(snr, scene, layout)
        measurement = self.measurement + sigma * rng.standard_normal(sigma.shape)
        bias = oscillator_bias(radio, scene.hz_per_mps, self.time_s, rng)
        measurement[:, layout.doppler] += bias
        if layout.has_bias:
            (own,) = rng.spawn(1)
            bias_m = clock_bias(layout.clock, bias / scene.hz_per_mps, self.time_s, own)
            measurement[:, layout.ranges] += bias_m[:, None]
        wrap_angles(measurement, layout)
        speed = np.linalg.norm(self.velocity_mps, axis=1)
        spread_hz = doppler_spread(radio, scene.hz_per_mps, speed, rng)
        return measurement, snr, spread_hz, bias


def _numbers(record: str, field: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return a new array of ``values``, refused unless it has this shape (None: any length > 0)."""
    array = np.array(values, float)
    wanted = [n or max(m, 1) for n, m in zip(shape, array.shape, strict=False)]
    if array.ndim != len(shape) or list(array.shape) != wanted:
        expected = str(shape).replace("None", "any")
        raise ValueError(
            f"{field} of {record}: found shape {array.shape}, expected shape {expected}"
        )
    return array
