"""What Sionna RT calls ``Paths``, as the paths of a scenario: receivers are the epochs of a track.

Sionna's arrays are [receiver, transmitter, path], those of interactions have a dimension of depth
in front; angles are azimuths and zenith angles that point away from either end, in radians.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.episodes.arrays import truth_of
from mmwave_env.episodes.deepmimo.paths import Paths, StationPaths
from mmwave_env.episodes.deepmimo.recording import recording_of
from mmwave_env.episodes.recorded import Recording
from mmwave_env.numerics.arrays import Array

_DIGITS = {1: 1.0, 2: 3.0, 4: 4.0, 8: 2.0}  # Sionna's interactions in DeepMIMO's digits
_OTHER = 9.0  # a digit of an interaction that neither knows
_ARRAYS = ("tau", "theta_r", "phi_r", "theta_t", "phi_t", "valid")  # (R, T, P)


def paths_from_sionna(paths: Any, carrier_hz: float, name: str = "sionna") -> Paths:
    """The paths between all transmitters and all receivers, the strongest first.

    Args:
        paths: ``sionna.rt.Paths`` of ``PathSolver()(..., synthetic_array=True)``, or what has its
            arrays. Of antenna arrays the first element counts.
        carrier_hz: of the scene they were traced in.
        name: for results and messages.

    Raises:
        ValueError: arrays of other shapes, such as those without synthetic arrays.
    """
    receivers, transmitters = np.array(paths.targets).T, np.array(paths.sources).T
    R, T = len(receivers), len(transmitters)
    arrays = {key: np.array(getattr(paths, key)) for key in _ARRAYS}
    P = arrays["tau"].shape[-1]
    for key, array in arrays.items():
        if array.shape != (R, T, P):
            raise ValueError(
                f"{name}: {key}: found shape {array.shape}, expected {(R, T, P)}, receivers x "
                "transmitters x paths: are the paths traced with synthetic_array=True?"
            )
    real, imaginary = (np.array(part, float)[:, 0, :, 0] for part in paths.a)
    gain = real + 1j * imaginary
    present = arrays["valid"].astype(bool) & (arrays["tau"] >= 0.0) & (gain != 0.0)
    with np.errstate(divide="ignore"):
        gain_db = np.where(present, 20.0 * np.log10(np.abs(gain)), -np.inf)
    interactions = _digits(np.array(paths.interactions))
    vertices = np.array(paths.vertices, float)
    first = vertices[0] if len(vertices) else np.zeros((R, T, P, 3))
    bounce = np.where(interactions[..., None] > 0.0, first, np.nan)
    arrival, departure = (
        np.stack([arrays[f"phi_{end}"], arrays[f"theta_{end}"]], axis=-1) for end in "rt"
    )

    def station(t: int) -> StationPaths:
        order = np.argsort(-gain_db[:, t], axis=1, kind="stable")
        order = order[:, : present[:, t].sum(axis=1).max(initial=0)]
        there = np.take_along_axis(present[:, t], order, axis=1)

        def strongest(values: Array) -> Array:
            axes = order.shape + (1,) * (values.ndim - 3)
            taken = np.take_along_axis(values[:, t], order.reshape(axes), axis=1)
            return np.where(there.reshape(axes), taken, np.nan)

        return StationPaths(
            name=f"transmitter {t}",
            position_m=transmitters[t].astype(float),
            interactions=strongest(interactions),
            bounce_m=strongest(bounce),
            gain_db=strongest(gain_db),
            delay_s=strongest(arrays["tau"].astype(float)),
            arrival=strongest(arrival.astype(float)),
            departure=strongest(departure.astype(float)),
            source=lambda key, epoch: (Path(name), epoch),
            phase_rad=strongest(np.angle(gain)),
        )

    return Paths(name, carrier_hz, receivers.astype(float), tuple(station(t) for t in range(T)))


def recording_from_sionna(
    paths: Any,
    time_s: ArrayLike,
    carrier_hz: float,
    velocity_mps: ArrayLike | None = None,
    *,
    virtual_anchors: int = 2,
    ground: bool = False,
    bandwidth_hz: float = 100e6,
    name: str = "sionna",
) -> Recording:
    """A recording of ``sionna.rt.Paths``, whose receivers are where one user was, in order.

    Anchors and Doppler shifts are those of a DeepMIMO scenario: a transmitter and its images in
    walls, or several transmitters, and the shift of the true velocity.

    Args:
        paths: as of :func:`paths_from_sionna`.
        time_s: (E,) when the user was at the receivers, increasing, s.
        carrier_hz: of the scene they were traced in.
        velocity_mps: (E, 3) of the user; None for differences of positions.
        virtual_anchors, ground, bandwidth_hz: as of
            :func:`~mmwave_env.episodes.deepmimo.recording.read_deepmimo`.
        name: for results and messages.

    Raises:
        ValueError: arrays of other shapes, no line of sight, or paths that contradict where
            receivers and transmitters are.
    """
    traced = paths_from_sionna(paths, carrier_hz, name)
    record = f"recording {name!r}"
    time, _, velocity = truth_of(record, time_s, traced.position_m, velocity_mps)
    return recording_of(traced, time, velocity, virtual_anchors, ground, bandwidth_hz)


def _digits(interactions: Array) -> Array:
    """Interactions (D, R, T, P) as one number (R, T, P): 0 line of sight, 11 two reflections."""
    number = np.zeros(interactions.shape[1:])
    for depth in interactions:
        digit = np.select([depth == i for i in (0, *_DIGITS)], [0.0, *_DIGITS.values()], _OTHER)
        number = np.where(digit > 0.0, 10.0 * number + digit, number)
    return number
