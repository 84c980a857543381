"""Corrections of a belief's position in the frame of motion.

The *frame of motion* has axes along the estimated horizontal velocity, across it (to the left) and
up. A correction has two numbers for each axis: the shift of the estimated position, in units of its
standard deviation along the axis, and the log of a factor that scales this standard deviation.
"""

from typing import NamedTuple

import numpy as np

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.numerics.linalg import product, symmetric, times
from mmwave_env.numerics.numbers import (
    Array,
    Matrix,
    Number,
    Numbers,
    Pair,
    Vector,
    exp,
    maximum,
    sqrt,
    where,
)

# largest shift (standard deviations) and log factor
MOST_SHIFT = 4.0
MOST_LOG_FACTOR = 2.0
SLOWEST_MPS = 1e-3  # below this speed, the x axis counts as the direction of motion


class Frame(NamedTuple):
    """The frame of motion, in which features are expressed and corrections are applied."""

    cosine: Number  # cosine of the angle from the x axis to the direction of motion
    sine: Number  # sine of this angle

    @classmethod
    def of(cls, velocity: Vector) -> "Frame":
        """Return the frame of a velocity (2,) or (3,), m/s."""
        vx = velocity[0]
        vy = velocity[1]
        speed = sqrt(vx * vx + vy * vy)
        moving = speed > SLOWEST_MPS
        scale = 1.0 / maximum(speed, SLOWEST_MPS)
        return cls(where(moving, vx * scale, 1.0), where(moving, vy * scale, 0.0))

    def into(self, x: Number, y: Number) -> Pair:
        """Return the components of a horizontal vector (x, y) along and across the motion."""
        return self.cosine * x + self.sine * y, self.cosine * y - self.sine * x

    def out(self, along: Number, across: Number) -> Pair:
        """Return the horizontal vector (x, y), given its components along and across the motion."""
        return self.cosine * along - self.sine * across, self.sine * along + self.cosine * across

    def covariance(self, P: Matrix, first: int = 0) -> tuple[Number, Number, Number]:
        """Return the variances of the components along and across the motion, and their covariance.

        Args:
            P: (n, n) covariance.
            first: index of x in P (0 for the position, 3 for the velocity); y has the next index.
        """
        c, s = self
        xx = P[first][first]
        yy = P[first + 1][first + 1]
        xy = P[first + 1][first]
        both = 2.0 * c * s * xy
        return (
            c * c * xx + both + s * s * yy,
            s * s * xx - both + c * c * yy,
            c * s * (yy - xx) + (c * c - s * s) * xy,
        )


def deviations_of(belief: Belief) -> tuple[Frame, Numbers]:
    """Return the frame of motion and the standard deviations (3,) of the position in it, m.

    On flat terrain, the standard deviation of the height is 0.
    """
    frame = Frame.of(belief.x[3:5])
    along, across, _ = frame.covariance(belief.P)
    up = belief.P[2][2] if 2 in belief.axes else 0.0 * along
    return frame, [sqrt(variance) for variance in (along, across, up)]


def corrected(belief: Belief, shift: Vector, log_factor: Vector) -> Belief:
    """Return the belief with its position shifted and the position's standard deviations scaled.

    The covariance P becomes M P M', where M scales the position in the frame of motion and
    leaves the other components as they are. M is invertible, so M P M' stays positive definite.

    Args:
        belief: belief to correct.
        shift: (3,) shifts in the frame of motion, in units of the belief's standard deviations.
        log_factor: (3,) logarithms of the factors that scale these standard deviations.
    """
    frame, deviations = deviations_of(belief)
    step = times(shift, deviations)
    dx, dy = frame.out(step[0], step[1])
    x = [belief.x[0] + dx, belief.x[1] + dy, belief.x[2] + step[2], *belief.x[3:]]
    a = exp(log_factor[0])
    b = exp(log_factor[1])
    c, s = frame
    xy = c * s * (a - b)
    M = [
        [c * c * a + s * s * b, xy, 0.0],
        [xy, s * s * a + c * c * b, 0.0],
        [0.0, 0.0, exp(log_factor[2])],
    ]
    MP = product(M, belief.P[:3])
    MPM = product(MP, M)

    def entry(i: int, j: int) -> Number:
        if i < 3:
            return MPM[i][j]
        return MP[j][i] if j < 3 else belief.P[i][j]

    return Belief(x, symmetric(len(belief.P), entry), belief.axes)


def corrected_all(
    x: Array, P: Array, shift: Array, log_factor: Array, pipeline: Pipeline
) -> Belief:
    """Correct a batch of beliefs in double precision; the result's components are arrays (...).

    Args:
        x, P: (..., 7) means and (..., 28) packed covariances (lower triangles) of the batch.
        shift, log_factor: (..., 3), same as for :func:`corrected`.
        pipeline: the filters' pipeline; it says whether the terrain is flat (``planar``).
    """

    def components(batch: Array) -> Numbers:
        return list(np.moveaxis(batch.astype(np.float64), -1, 0))

    belief = pipeline.belief(components(x), components(P))
    return corrected(belief, components(shift), components(log_factor))
