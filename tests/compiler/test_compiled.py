"""What numba compiles does what its Python source says, so that either may run."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence

from mmwave_env.compiler.disk_cache import LazyJit
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.pytree import flatten, unflatten
from mmwave_env.world import mobility
from mmwave_env.world.simulated import SimulatedSource
from tests.paths import representative


@pytest.fixture
def go(monkeypatch: pytest.MonkeyPatch):
    """A call that has sparing functions run "compiled" or "plain" from then on."""

    def begin(way: str) -> None:
        def run(function: LazyJit, _: int, *arguments: object) -> object:
            return getattr(function, way)(*arguments)

        monkeypatch.setattr(LazyJit, "__call__", run)
        monkeypatch.setattr(LazyJit, "choice", lambda function, *_: getattr(function, way))

    return begin


@pytest.mark.parametrize("scenario", mobility.MOBILITIES)
def test_episodes_are_the_same_to_the_bit(scenario, go):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario)
    keys = np.arange(3, dtype=np.uint64)
    go("compiled")
    compiled = source.sample_batch(keys)
    go("plain")
    plain = source.sample_batch(keys)
    np.testing.assert_array_equal(compiled.table, plain.table)
    np.testing.assert_array_equal(compiled.site, plain.site)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_environments_are_the_same_to_the_bit(mode, go):
    def run(way):
        go(way)
        envs = gym.make_vec("MmWaveLoc-v0", num_envs=9, episode_steps=12, autoreset_mode=mode)
        found = [envs.reset(seed=0)]
        found += [envs.step(np.arange(9) % 2) for _ in range(14)]
        return found

    assert data_equivalence(run("plain"), run("compiled"), exact=True)


@pytest.mark.parametrize("scenario", representative(mobility.MOBILITIES, "walk-ride"))
def test_a_world_on_lanes_is_the_world_on_floats(scenario):
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], scenario, epochs=60)
    episodes = source.sample_batch(np.arange(3, dtype=np.uint64))
    begun, world = source.begin(np.arange(3, dtype=np.uint64)), source.world
    settings = source.feed(begun.worlds).settings[:, 0]
    blank = np.zeros(world.ends[0])
    for kept, expected in zip(begun.worlds, episodes.table, strict=True):
        w = unflatten(world.template, iter(np.concatenate([blank, settings, kept]).tolist()))
        table = []
        for dt in source.steps_s:
            w = world.epoch(w)
            table.append(flatten(w.measured._replace(dt=dt)))
        np.testing.assert_allclose(table, expected, rtol=1e-9, atol=1e-9)
