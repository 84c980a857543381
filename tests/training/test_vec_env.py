"""Several places as one vector environment: the same as each of them alone."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from experiments.training.places import places_from
from experiments.training.training_task import TrainingTask
from experiments.training.vec_env import PlacesVecEnv
from mmwave_env.filters.bank import Bank
from mmwave_env.reward import PairedReward, TrackingReward
from mmwave_env.sb3 import SB3VecEnv
from mmwave_env.vector_env import MmWaveLocVectorEnv
from tests.training.actors import MODES
from tests.training.test_train import HYPER

pytestmark = pytest.mark.torch

PAIR = MODES[:2]  # quick to compile
PLACES = places_from(["street:handset", "o1:standard:0.5"])
SLOWER = Bank(tuple(replace(mode, sigma_v=0.5 * mode.sigma_v) for mode in PAIR), None, 0.99)
TASK = TrainingTask(
    "mixed", PLACES, {"handset": Bank(PAIR), "standard": SLOWER}, "full", TrackingReward(),
    "per-mode",
)  # fmt: skip
PAIRED = replace(HYPER, num_envs=5, paired=True)  # three environments and two


def alone(place, n):
    """The environments of a place, without any other."""
    arguments = TASK.arguments(place) | {"reward": PairedReward(TASK.reward)}
    return SB3VecEnv(MmWaveLocVectorEnv(n, **arguments, autoreset_mode="SameStep"))


def assert_same_ends(found, expected):
    for x, y in zip(found, expected, strict=True):
        assert x.get("episode", {}).get("r") == y.get("episode", {}).get("r")
        assert x.get("ate_m") == y.get("ate_m")
        last = (info.get("terminal_observation", 0) for info in (x, y))
        np.testing.assert_array_equal(*last)


@pytest.mark.slow
def test_several_places_are_what_each_of_them_is_alone():
    """Seeds go on from place to place; later places are ahead, so that episodes end by turns."""
    together = PlacesVecEnv(TASK, PAIRED)
    first, second = alone(PLACES[0], 3), alone(PLACES[1], 2)
    together.seed(10_000_000)
    first.seed(10_000_000)
    second.seed(10_000_003)
    seen = together.reset()
    theirs = [first.reset(), second.reset()]
    for _ in range(100):
        theirs[1], *_ = second.step(np.zeros(2, int))
    np.testing.assert_array_equal(seen, np.concatenate(theirs))
    rng, ends = np.random.default_rng(0), []
    for t in range(210):
        actions = rng.integers(3, size=5)
        seen, rewards, over, infos = together.step(actions)
        a, b = first.step(actions[:3]), second.step(actions[3:])
        for found, *parts in zip((seen, rewards, over), a, b, strict=False):
            np.testing.assert_array_equal(found, np.concatenate(parts))
        assert_same_ends(infos, a[3] + b[3])
        ends += [(t, i) for i in np.flatnonzero(over)]
    assert ends == [(99, 3), (99, 4), (199, 0), (199, 1), (199, 2)]


@pytest.mark.slow
def test_several_places_go_on_to_the_last_bit():
    first, second = PlacesVecEnv(TASK, PAIRED), PlacesVecEnv(TASK, PAIRED)
    for env, seed in ((first, 0), (second, 99)):
        env.seed(seed)
        env.reset()
    actions = np.random.default_rng(0).integers(3, size=(120, 5))
    for now in actions[:90]:
        first.step(now)
    second.restore(first.state())
    for now in actions[90:]:
        (*a, told), (*b, their_told) = (env.step(now) for env in (first, second))
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
        assert_same_ends(told, their_told)


def test_what_algorithms_ask_is_answered_for_every_environment():
    venv = PlacesVecEnv(TASK, PAIRED)
    assert [source.dt for source in venv.get_attr("source")] == [1.0, 1.0, 1.0, 0.5, 0.5]
    assert [source.dt for source in venv.get_attr("source", [3, 0])] == [0.5, 1.0]
    with pytest.raises(ValueError, match=r"set_attr\('source'\): found indices 1, expected None"):
        venv.set_attr("source", None, 1)


def test_there_is_an_environment_for_every_place():
    with pytest.raises(ValueError, match="num_envs: found 1, expected 2 or more"):
        PlacesVecEnv(TASK, replace(PAIRED, num_envs=1))
