"""Users on their way, one by one."""

import numpy as np

from mmwave_env.compiler.rng import whole_rng
from mmwave_env.episodes.kinematics import motion
from mmwave_env.episodes.travel import stride_of, travel


def trajectories(plan, kinds, dt, rngs, out):
    """Fill (n, epochs, 6) with positions (m) and velocities (m/s) of users of a plan's kinds."""
    for kind, rng, row in zip(kinds, rngs, out, strict=True):
        kind = np.array([kind])
        travel(whole_rng(rng), 0, kind, plan, dt, stride_of(dt), *motion(), row[None])
