"""Motion of a user: constant velocity with noise (paper, Sec. II-A and III-B), and maneuvers."""

from typing import NamedTuple

from mmwave_env.models.layout import STATE_SIZE
from mmwave_env.numerics.linalg import dot, plus, symmetric
from mmwave_env.numerics.numbers import Matrix, Number, Numbers, Vector, maximum, sqrt

STANDING_MPS = 0.2  # far below this speed, the direction is unclear, so accelerate() does little
# White noise of a user's clock, m / sqrt(s), besides the drift due to the oscillator's bias. Its
# square is 0.01 m^2/s, as for a temperature-compensated crystal (Groves 2013, Sec. 9.4.2).
CLOCK_SIGMA_M = 0.1
# pairs of state components that noise couples: velocities and positions, range bias and bias
COUPLED = ((3, 0), (4, 1), (5, 2), (7, 6))
FREE_BIAS_M = 1e3  # standard deviation of the range bias of a free clock; 1 km is 3.3 us
_SHORTEST_S = 1e-9  # shortest step by which a speed is divided


class ProcessNoise(NamedTuple):
    """The non-zero entries of the process noise covariance Q."""

    # variances (7,), m^2, (m/s)^2, Hz^2; or (8,), the last for the range bias of a clock, m^2
    diagonal: Numbers
    # covariances (3,) of position and velocity per axis, m^2/s; or (4,), the last for the
    # range bias of a clock and the oscillator's bias, m Hz
    coupling: Numbers


def white_noise_acceleration(
    position: Vector, velocity: Vector, bias: Number, dt: Number, coupling: Number
) -> ProcessNoise:
    """Return the process noise covariance Q over a step dt, s, given variances per second.

    The variances added per second are those of the position (3,), in m^2; of the velocity (3,), in
    (m/s)^2; and of the oscillator's bias, in Hz^2.

    With ``coupling`` 1, the velocity noise also moves the position, like a constant acceleration
    in the step (discrete white-noise acceleration, Bar-Shalom et al. 2001, Sec. 6.3.2). On an axis,
    a velocity noise of variance q = ``velocity`` * dt then adds [[q dt^2 / 4, q dt / 2],
    [q dt / 2, q]] to Q, which is positive semidefinite for any variances. With ``coupling`` 0, Q is
    the paper's diagonal matrix, which understates the growth of the position's variance.
    """
    q = [v * dt for v in velocity]
    half = coupling * (0.5 * dt)
    spread = [p * dt + v * (half * half) for p, v in zip(position, q, strict=True)]
    return ProcessNoise([*spread, *q, bias * dt], [v * half for v in q])


def with_clock(
    noise: ProcessNoise, hz_per_mps: Number | None, dt: Number, coupling: Number
) -> ProcessNoise:
    """Extend the process noise of a step ``dt``, s, to a state with the clock's range bias B.

    One oscillator drives the carrier and the clock. Its bias b changes B at the rate
    b / hz_per_mps, as a velocity changes a position. Within a step, the noise of b moves B as the
    velocity noise moves the position in :func:`white_noise_acceleration`. The clock's own noise is
    added (Groves 2013, Sec. 9.4.2; Brown and Hwang 2012, Sec. 9.3). If the clock is free, which
    ``hz_per_mps`` None says, B is all noise.
    """
    if hz_per_mps is None:
        return ProcessNoise([*noise.diagonal, FREE_BIAS_M**2], [*noise.coupling, 0.0])
    half = coupling * (0.5 * dt) / hz_per_mps
    drift = noise.diagonal[-1]
    own = CLOCK_SIGMA_M**2 * dt + drift * (half * half)
    return ProcessNoise([*noise.diagonal, own], [*noise.coupling, drift * half])


def move(x: Vector, dt: Number, hz_per_mps: Number | None = None) -> Numbers:
    """Return F x, the mean one step later.

    If x is (8,), ``hz_per_mps`` says how the oscillator drives the range bias; None if the clock is
    free, so that the new range bias does not depend on the old one.
    """
    moved = [x[i] + dt * x[i + 3] if i < 3 else x[i] for i in range(min(len(x), STATE_SIZE))]
    if hz_per_mps is None:
        return moved + [0.0] * len(x[STATE_SIZE:])
    return moved + [bias + (dt / hz_per_mps) * x[6] for bias in x[STATE_SIZE:]]


def accelerate(x: Vector, acceleration: Number, dt: Number) -> Numbers:
    """Return the mean (7,) after a step with a known acceleration along the horizontal velocity.

    ``x`` (7,) is the mean that a constant velocity leads to after ``dt`` seconds. The acceleration
    (m/s^2) is a known input (Bar-Shalom et al. 2001, Sec. 5.2): it changes this mean, but not the
    covariance. A negative acceleration brakes, at most to a standstill.
    """
    v = x[3:5]
    speed = sqrt(dot(v, v) + STANDING_MPS**2)
    a = maximum(acceleration, -speed / maximum(dt, _SHORTEST_S))
    change = [a * dt * (component / speed) for component in v]
    moved = [x[i] + (0.5 * dt) * change[i] for i in range(2)]
    return [*moved, x[2], *plus(v, change), *x[5:]]


def transition_times(P: Matrix, dt: Number, hz_per_mps: Number | None = None) -> Matrix:
    """Return F P, with the transition matrix F of :func:`move` and a symmetric P."""
    return [list(row) for row in zip(*[move(row, dt, hz_per_mps) for row in P], strict=True)]


def predict_covariance(
    P: Matrix, noise: ProcessNoise, dt: Number, hz_per_mps: Number | None = None
) -> Matrix:
    """Return F P F' + Q, the covariance one step later."""
    moved = [move(row, dt, hz_per_mps) for row in transition_times(P, dt, hz_per_mps)]
    for i, variance in enumerate(noise.diagonal):
        moved[i][i] = moved[i][i] + variance
    for (i, j), covariance in zip(COUPLED, noise.coupling, strict=False):
        moved[i][j] = moved[i][j] + covariance
    return symmetric(len(P), lambda i, j: moved[i][j])
