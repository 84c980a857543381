"""A way that is given, and an episode."""

from types import SimpleNamespace

import numpy as np

from mmwave_env.world.trajectory import Trajectory


def around_a_block(corner=(10.0, -20.0)):
    """A minute and a half along two sides of a block, faster and slower, at uneven times."""
    time_s = np.cumsum(np.tile([0.4, 1.0, 2.1, 0.8], 21)) + 1000.0
    passed = time_s - time_s[0]
    traveled = 2.0 * passed + 4.0 * np.sin(passed / 9.0)
    x, y = np.minimum(traveled, 80.0), np.maximum(traveled - 80.0, 0.0)
    position = np.column_stack([corner[0] + x, corner[1] - y, np.full(len(x), 1.5)])
    return Trajectory("block", time_s, position)


def replay(episode):
    """An episode source that knows one episode."""
    return SimpleNamespace(
        layout=episode.layout, epochs=len(episode), name=episode.name, sample=lambda rng: episode
    )
