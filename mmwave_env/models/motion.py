"""Constant-velocity motion: process noise and prediction (paper, Sec. II-A and III-B)."""

from typing import NamedTuple

from mmwave_env.models.measurement import STATE_SIZE
from mmwave_env.numerics.linalg import symmetric
from mmwave_env.numerics.numbers import Matrix, Number, Vector


class ProcessNoise(NamedTuple):
    """Q as its non-zero entries."""

    diagonal: list[Number]  # (7,) variances, m^2, (m/s)^2 and Hz^2
    coupling: list[Number]  # (3,) covariances of position and velocity per axis, m^2/s


def white_noise_acceleration(
    position: Vector, velocity: Vector, bias: Number, dt: Number, coupling: Number
) -> ProcessNoise:
    """Q over a step from variances per second.

    With ``coupling`` 1 the velocity noise q = velocity dt moves the position as a constant
    acceleration over the step does, [[q dt^2 / 4, q dt / 2], [q dt / 2, q]] (discrete
    white-noise acceleration, Bar-Shalom et al. 2001, Sec. 6.3.2), on top of the position
    noise, so Q is positive semidefinite for any variances. With 0, Q is the paper's plain
    diagonal, which at dt = 1 s underestimates how position uncertainty grows.

    Args:
        position: (3,) m^2 per second.
        velocity: (3,) (m/s)^2 per second.
        bias: Hz^2 per second.
        dt: step, seconds.
        coupling: 1 where velocity noise also moves the position within the step, else 0.
    """
    q = [v * dt for v in velocity]
    half = coupling * (0.5 * dt)
    spread = [p * dt + v * (half * half) for p, v in zip(position, q, strict=True)]
    return ProcessNoise([*spread, *q, bias * dt], [v * half for v in q])


def move(x: Vector, dt: Number) -> list[Number]:
    """F x: the mean one step on."""
    return [x[i] + dt * x[i + 3] if i < 3 else x[i] for i in range(STATE_SIZE)]


def transition_times(P: Matrix, dt: Number) -> list[list[Number]]:
    """F P."""
    n = STATE_SIZE
    return [[P[i][j] + dt * P[i + 3][j] if i < 3 else P[i][j] for j in range(n)] for i in range(n)]


def predict_covariance(P: Matrix, noise: ProcessNoise, dt: Number) -> list[list[Number]]:
    """F P F' + Q."""
    FP = transition_times(P, dt)

    def entry(i: int, j: int) -> Number:
        value = FP[i][j] + FP[i][j + 3] * dt if j < 3 else FP[i][j]
        if i == j:
            return value + noise.diagonal[i]
        return value + noise.coupling[j] if i == j + 3 and j < 3 else value

    return symmetric(STATE_SIZE, entry)
