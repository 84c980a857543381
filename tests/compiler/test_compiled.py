"""A simulated world on lanes does what its equations say on floats."""

import numpy as np
import pytest

from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.world import mobility
from mmwave_env.world.simulated import SimulatedSource
from tests.paths import representative


@pytest.mark.parametrize("scenario", representative(mobility.MOBILITIES, "walk-ride"))
def test_a_world_on_lanes_is_the_world_on_floats(scenario):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    episodes = source.sample_batch(np.arange(3, dtype=np.uint64))
    begun, world = source.begin(np.arange(3, dtype=np.uint64)), source.world
    settings = source.feed(begun.worlds).settings[:, 0]
    blank, (observed, happened, moved) = np.zeros(world.ends[0]), world.parts
    for kept, expected in zip(begun.worlds, episodes.table, strict=True):
        w = unflatten(world.template, iter(np.concatenate([blank, settings, kept]).tolist()))
        table = []
        for dt in source.steps_s:
            w = observed(w)
            for _ in range(int(w.settings.stride)):
                w = moved(happened(w))
            table.append(flatten(w.measured._replace(dt=dt)))
        np.testing.assert_allclose(table, expected, rtol=1e-9, atol=1e-9)
