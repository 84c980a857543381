"""Measured tracks: logs with the true positions of the user, replayed as they were measured.

Measurements are the same in every episode. A seed determines only the prior and, if episodes are
shorter than the log, the epoch of the log at which an episode begins.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.datasets.tracks import Received, Track, numbers
from mmwave_env.models.layout import LINK, Layout, sigma_name, whole_groups, without_noise
from mmwave_env.models.radio import Radio
from mmwave_env.numerics.numbers import Array, Mask
from mmwave_env.world.checks import refuse


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasuredTrack(Track):
    """T epochs of one user with measurements of a real receiver, and with the true positions.

    :meth:`from_arrays` makes a track from arrays;
    :func:`~mmwave_env.datasets.log_folder.read_log_folder` reads one from files.

    Angles are in the frame of the map. As in the uplink, angles of arrival give the direction
    (dx, dy, dz) from the anchor to the user: azimuth ``atan2(dy, dx)``, elevation
    ``atan2(dz, hypot(dx, dy))``. "Departure" is the azimuth from the user to the anchor. A virtual
    anchor is a mirror image of the base station; its angles are those of the straight line between
    image and user. docs/data.md, "Angles", converts other conventions. A link may lack some of its
    values. A value that has no SNR and no standard deviation counts as not measured, because its
    noise is unknown.

    Attributes:
        snr_db: (T, L) SNR of every link; -inf where no SNR was measured.
        doppler_spread_hz: (T,) Doppler spread.
    """

    snr_db: Array
    doppler_spread_hz: Array

    @classmethod
    def from_arrays(
        cls,
        *,
        time_s: ArrayLike,
        anchors_m: ArrayLike,
        position_m: ArrayLike,
        range_m: ArrayLike | None = None,
        aoa_azimuth_rad: ArrayLike | None = None,
        aoa_elevation_rad: ArrayLike | None = None,
        aod_azimuth_rad: ArrayLike | None = None,
        doppler_hz: ArrayLike | None = None,
        snr_db: ArrayLike | None = None,
        range_sigma_m: ArrayLike | None = None,
        aoa_azimuth_sigma_rad: ArrayLike | None = None,
        aoa_elevation_sigma_rad: ArrayLike | None = None,
        aod_azimuth_sigma_rad: ArrayLike | None = None,
        doppler_sigma_hz: ArrayLike | None = None,
        doppler_spread_hz: ArrayLike | None = None,
        velocity_mps: ArrayLike | None = None,
        carrier_hz: float = 28e9,
        bandwidth_hz: float = 100e6,
        name: str = "own",
    ) -> "MeasuredTrack":
        """Return a track made from arrays, in which NaN marks values that are not known.

        Args:
            time_s, anchors_m: (T,) increasing times, s; (L, 3) base station, virtual anchors, m.
            position_m, velocity_mps: (T, 3) true positions; velocities, by default their slopes.
            range_m: (T, L) ranges of links: speed of light times one-way time of flight, m.
            aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad: (T, L) angles of links, rad.
            doppler_hz: (T,) Doppler shift of the base station, positive while the range grows.
            snr_db: (T, L) SNR of links, dB; with the radio, it determines the noise.
            range_sigma_m, aoa_azimuth_sigma_rad, aoa_elevation_sigma_rad, aod_azimuth_sigma_rad:
                the receiver's own standard deviations, in place of the profile's.
            doppler_sigma_hz: the same for the Doppler shift.
            doppler_spread_hz: (T,) Doppler spread; None, NaN or 0 if it was not measured.
            carrier_hz, bandwidth_hz, name: frequencies of the signal; the track's name.

        Raises:
            ValueError: arrays are wrong, or too few, or their noise is unknown; see the message.
        """
        record = f"{cls.KIND} {name!r}"
        links = (range_m, aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad)
        deviations = (
            range_sigma_m, aoa_azimuth_sigma_rad, aoa_elevation_sigma_rad, aod_azimuth_sigma_rad,
            doppler_sigma_hz,
        )  # fmt: skip
        measured = dict(zip((*LINK, "doppler_hz"), (*links, doppler_hz), strict=True))
        sigma_of = dict(zip(measured, deviations, strict=True))
        _require_noise(record, measured, sigma_of, snr_db)
        truth = (position_m, velocity_mps)
        signal = (carrier_hz, bandwidth_hz)
        fields, snr = cls._fields(
            name, time_s, anchors_m, links, ("snr_db", snr_db), truth, signal, doppler_hz
        )
        fields |= _as_partial(record, fields, np.isfinite(snr), sigma_of)
        spread = numbers(record, "doppler_spread_hz", doppler_spread_hz, (len(snr),))
        snr = np.where(np.isnan(snr), -np.inf, snr)
        return cls(**fields, snr_db=snr, doppler_spread_hz=np.nan_to_num(spread))

    def _received(self, radio: Radio, rng: np.random.Generator, epochs: slice) -> Received:
        spread = self.doppler_spread_hz[epochs]
        return Received(self.measurement[epochs], self.snr_db[epochs], spread, None)


def _require_noise(
    record: str,
    measured: dict[str, ArrayLike | None],
    deviations: dict[str, ArrayLike | None],
    snr_db: ArrayLike | None,
) -> None:
    """Refuse arrays without information about the horizontal position, or with unknown noise."""
    horizontal = [name for name in LINK if "elevation" not in name]
    if all(measured[name] is None for name in horizontal):
        refuse(record, ", ".join(horizontal), "none of them", "one or more")
    for name, values in measured.items():
        if values is not None and deviations[name] is None and snr_db is None:
            refuse(record, name, "unknown noise", f"also {sigma_name(name)} or snr_db")


def _as_partial(
    record: str, fields: dict[str, Any], heard: Mask, deviations: dict[str, ArrayLike | None]
) -> dict[str, Any]:
    """Return the ``fields`` that a partial layout changes; {} if the plain layout suffices.

    The plain layout suffices if no standard deviations are given, and every link has all of its
    values or none. ``heard`` (T, L) says whether a link has an SNR. ``deviations`` maps names of
    measurements to standard deviations: (T, L) for links, (T,) for Doppler shifts, or None.
    """
    layout: Layout = fields["layout"]
    rows = fields["measurement"]
    sigma = np.full_like(fields["measurement"], np.nan)
    for i, (name, values) in enumerate(deviations.items()):
        link = i < len(LINK)
        shape = heard.shape if link else heard.shape[:1]
        stated = numbers(record, sigma_name(name), values, shape)
        if (stated <= 0.0).any():
            expected = "more than 0, or NaN if unknown"
            refuse(record, sigma_name(name), stated[stated <= 0.0][0], expected)
        sigma[:, slice(i, layout.doppler, 4) if link else layout.doppler] = stated
    shifted = np.zeros(len(rows), np.int64)
    kept = np.where(without_noise(rows, sigma, heard, shifted, layout), np.nan, rows)
    partial = replace(layout, partial=True)
    visible, _ = whole_groups(kept, heard, partial)
    if not np.isfinite(sigma).any() and np.array_equal(visible, fields["visible"]):
        return {}
    return {"layout": partial, "measurement": kept, "visible": visible, "sigma": sigma}
