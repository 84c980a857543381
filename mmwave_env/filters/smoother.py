"""Rauch-Tung-Striebel smoothing of a finished track (paper, Sec. III-F)."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import Program, Tracks, Traffic, rows_of
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.models.measurement import STATE_SIZE
from mmwave_env.models.motion import move
from mmwave_env.numerics.linalg import backward, cholesky, dot, forward, pack, symmetric, unpack
from mmwave_env.numerics.numbers import Matrix, Number, Vector
from mmwave_env.numerics.pytree import select

Array = NDArray[np.float64]


class Filtered(NamedTuple):
    """One epoch of a finished track.

    Attributes:
        x, P: (7,), (28,) belief after the epoch.
        P_predicted: (28,) covariance predicted for the *next* epoch.
        dt: seconds to the next epoch.
    """

    x: list[Number]
    P: list[Number]
    P_predicted: list[Number]
    dt: Number


class Workspace(NamedTuple):
    """The smoother between two epochs, going backwards.

    Attributes:
        incoming: the epoch before.
        last: 1 at the last epoch of the track, whose belief is already smooth.
        x, P: (7,), (28,) smoothed belief of the epoch at hand.
    """

    incoming: Filtered
    last: Number
    x: list[Number]
    P: list[Number]


def _moved(P: Matrix, dt: Number) -> list[list[Number]]:
    """F P."""
    n = STATE_SIZE
    return [[P[i][j] + dt * P[i + 3][j] if i < 3 else P[i][j] for j in range(n)] for i in range(n)]


def rts_mean(x: Vector, P: Matrix, factor: Matrix, x_next: Vector, dt: Number) -> list[Number]:
    """Smoothed mean of an epoch: x + P F' P_predicted^-1 (x_next - F x) (paper, Sec. III-F).

    Args:
        x, P: (7,), (7, 7) filtered belief of the epoch.
        factor: (7, 7) Cholesky factor of P_predicted, predicted for the next epoch.
        x_next: (7,) smoothed mean of the next epoch.
        dt: seconds to the next epoch.
    """
    FP = _moved(P, dt)
    step = [a - b for a, b in zip(x_next, move(x, dt), strict=True)]
    y = backward(factor, forward(factor, step))
    return [a + dot([row[i] for row in FP], y) for i, a in enumerate(x)]


def rts_step(
    now: Filtered, x_next: Vector, P_next: Vector, pinned: tuple[int, ...] = ()
) -> tuple[list[Number], list[Number]]:
    """Smoothed belief of an epoch from that of the next: C = P F' P_predicted^-1 (Sec. III-F).

    Args:
        now: the epoch.
        x_next, P_next: (7,), (28,) smoothed belief of the next epoch.
        pinned: state components that are known exactly.
    """
    P = unpack(now.P, zero=pinned)
    P_predicted = unpack(now.P_predicted, zero=pinned)
    factor, FP = cholesky(P_predicted), _moved(P, now.dt)
    # Row i of the gain: P_predicted^-1 times column i of F P.
    gain = [
        backward(factor, forward(factor, [FP[k][i] for k in range(STATE_SIZE)]))
        for i in range(STATE_SIZE)
    ]
    change = [
        [a - b for a, b in zip(u, v, strict=True)]
        for u, v in zip(unpack(P_next, zero=pinned), P_predicted, strict=True)
    ]
    half = [[dot(gain[i], [change[k][j] for k in range(STATE_SIZE)])
             for j in range(STATE_SIZE)] for i in range(STATE_SIZE)]  # fmt: skip
    smoothed = symmetric(STATE_SIZE, lambda i, j: P[i][j] + dot(half[i], gain[j]))
    return rts_mean(now.x, P, factor, x_next, now.dt), pack(smoothed)


@lru_cache(maxsize=2)
def _program(pinned: tuple[int, ...]) -> Program[Workspace]:
    def function(w: Workspace) -> Workspace:
        x, P = rts_step(w.incoming, w.x, w.P, pinned)
        last = w.last > 0.5
        x, P = select(last, w.incoming.x, x), select(last, w.incoming.P, P)
        return w._replace(last=0.0, x=x, P=P)

    identity = [float(i == j) for i in range(STATE_SIZE) for j in range(i + 1)]
    mean = [0.0] * STATE_SIZE
    incoming = Filtered(mean, identity, identity, 1.0)
    return Program(function, Workspace(incoming, 1.0, mean, identity))


def smooth(
    x: Array, P: Array, P_predicted: Array, dt: Array, planar: bool = False
) -> tuple[Array, Array]:
    """Smoothed means (N, T, 7) and packed covariances (N, T, 28) of finished tracks.

    Args:
        x: (N, T, 7) filtered means.
        P: (N, T, 28) filtered covariances, packed.
        P_predicted: (N, T, 28) covariances predicted for each epoch, before its update.
        dt: (T - 1,) seconds from each epoch to the next, or (N, T - 1) of every track's own.
        planar: z and vz are known exactly.
    """
    program = _program(VERTICAL if planar else ())
    N, T, _ = x.shape
    table = np.zeros((N, T, STATE_SIZE + 2 * P.shape[2] + 1))  # backwards in time
    at_P, at_coming = STATE_SIZE, STATE_SIZE + P.shape[2]
    table[..., :at_P], table[..., at_P:at_coming] = x[:, ::-1], P[:, ::-1]
    table[:, 0, at_coming:-1] = P_predicted[:, -1]  # unused at the last epoch, but sound
    table[:, 1:, at_coming:-1] = P_predicted[:, :0:-1]
    table[:, 1:, -1] = dt[..., ::-1]
    rows = np.zeros((-(-N // WIDTH), program.size, WIDTH))
    at = program.index
    rows[:, at.last] = 1.0
    traffic = Traffic.of(N, T, keep=rows_of([at.x, at.P]))
    program.run_on_lanes(Tracks.of(table, rows), traffic)
    smoothed = traffic.kept[:, ::-1]
    return smoothed[..., :STATE_SIZE].copy(), smoothed[..., STATE_SIZE:].copy()
