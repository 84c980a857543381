"""Rauch-Tung-Striebel smoothing, which runs backwards, epoch by epoch (paper, Sec. III-F).

Source: Särkkä, "Bayesian Filtering and Smoothing" (2013), Sec. 8.2. The book's form with matrices
is :func:`mmwave_env.filters.textbook.rts`.
"""

from typing import NamedTuple

from mmwave_env.models.motion import transition_times
from mmwave_env.numerics.linalg import (
    backward,
    cholesky,
    dot,
    forward,
    minus,
    pack,
    plus,
    product,
    symmetric,
    unpack,
)
from mmwave_env.numerics.numbers import Number, Numbers, Vector

SMOOTHING_WINDOW = 200  # epochs; N_w of the paper, Sec. III-F


class TrackEpoch(NamedTuple):
    """An epoch of a track, filtered or smoothed."""

    dt: Number  # seconds since the previous epoch
    # x, P: mean (7,) and packed covariance (28,), its lower triangle
    x: Numbers
    P: Numbers
    # x_predicted, P_predicted: mean and covariance before the filter's update
    x_predicted: Numbers
    P_predicted: Numbers
    hz_per_mps: Vector  # (1,) f_c / c if the oscillator drives a range bias; else empty


def blank_epoch(size: int, driven: bool) -> TrackEpoch:
    """Return a placeholder epoch with valid numbers, to be overwritten.

    ``driven`` tells whether the state has a range bias that the oscillator drives.
    """
    identity = [float(i == j) for i in range(size) for j in range(i + 1)]
    nothing = [0.0] * size
    return TrackEpoch(1.0, nothing, identity, nothing, identity, [1.0] * driven)


def smooth_epoch(now: TrackEpoch, after: TrackEpoch, known_axes: tuple[int, ...]) -> TrackEpoch:
    """Smooth the belief of a filtered epoch, with the gain C = P F' P_predicted^-1.

    The mean is x + C (x_after - x_predicted), the covariance is P + C (P_after - P_predicted) C'.
    ``after`` is the following epoch, smoothed; the last epoch of a track needs no smoothing.
    """
    P = unpack(now.P, zero=known_axes)
    P_predicted = unpack(after.P_predicted, zero=known_axes)
    factor = cholesky(P_predicted)
    FP = transition_times(P, after.dt, *now.hz_per_mps)
    n = len(P)
    # Row i of the gain is P_predicted^-1 times column i of F P.
    gain = [backward(factor, forward(factor, column)) for column in zip(*FP, strict=True)]
    change = list(map(minus, unpack(after.P, zero=known_axes), P_predicted))
    half = product(gain, change)
    smoothed = symmetric(n, lambda i, j: P[i][j] + dot(half[i], gain[j]))
    y = backward(factor, forward(factor, minus(after.x, after.x_predicted)))
    mean = plus(now.x, product([y], FP)[0])
    return now._replace(x=mean, P=pack(smoothed))
