"""PPO on arrays: the rollouts and updates of Stable-Baselines3's own loop."""

import csv
import io
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from experiments.training import ppo
from experiments.training.fast_ppo import FastPPO
from experiments.training.hyperparameters import read_hyperparameters, shipped_hyperparameters
from experiments.training.job import Job
from experiments.training.network import learner
from experiments.training.places import places_from
from experiments.training.training_env import TrainingEnv
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.mode_files import default_modes
from tests.training.actors import MODES
from tests.training.test_train import RECIPE, TASK

pytestmark = pytest.mark.torch

LONG = replace(
    RECIPE, num_envs=5, n_steps=210, batch_size=70, paired=True
)  # episodes end after 200 epochs
RECIPES = {
    "ppo": LONG,
    "truth": replace(LONG, truth_critic=True),
    "frames": replace(LONG, frames=3),
    "places": LONG,
    "truth at places": replace(LONG, truth_critic=True, paired=False),
}
PLACES = places_from(["street:handset", "o1:standard:0.5"])
AT_PLACES = replace(
    TASK, places=PLACES, banks=dict.fromkeys(["handset", "standard"], Bank(MODES)),
    beliefs="per-mode",
)  # fmt: skip
CLOSE = {"rtol": 1e-5, "atol": 1e-5}


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


class Listener(BaseCallback):
    """Remembers what is told of episodes that end."""

    def __init__(self):
        super().__init__()
        self.ended = []

    def _on_step(self):
        self.ended += [info for info in self.locals["infos"] if "episode" in info]
        return True


def begun(kind, fast, seed=3):
    """A learner before its first rollout, its world, and a listener."""
    task = AT_PLACES if "places" in kind else TASK
    world = TrainingEnv(task, RECIPES[kind])
    model = learner(world, RECIPES[kind], seed, fast)
    model.set_logger(Logger(None, []))
    _, listener = model._setup_learn(10**6, Listener())
    return model, world, listener


def collect(model, listener):
    model.collect_rollouts(model.env, listener, model.rollout_buffer, model.n_steps)


def assert_same_rollout(ours, theirs):
    np.testing.assert_array_equal(ours.actions, theirs.actions)
    np.testing.assert_array_equal(ours.episode_starts, theirs.episode_starts)
    assert ours.episode_starts.any() and ours.full and ours.pos == theirs.pos
    for name in ("rewards", "values", "log_probs", "advantages", "returns"):
        np.testing.assert_allclose(
            getattr(ours, name), getattr(theirs, name), **CLOSE, err_msg=name
        )
    assert_same_observations(ours.observations, theirs.observations)


def assert_same_observations(ours, theirs):
    """A feature that hardly varies is divided by a small deviation, and so is its last digit."""
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=3e-5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", RECIPES)
def test_rollouts_are_those_of_stable_baselines3(kind):
    """Two of them: the second goes on where the first left the world."""
    ours, theirs = begun(kind, fast=True), begun(kind, fast=False)
    assert type(ours[0]) is FastPPO and type(theirs[0]) is PPO
    for _ in range(2):
        for (model, world, listener), torch_state in zip((ours, theirs), states(), strict=True):
            torch.set_rng_state(torch_state)
            collect(model, listener)
            for adapter in world.adapters:
                assert (adapter.state()["lengths"] > 0).any()
        assert_same_rollout(ours[0].rollout_buffer, theirs[0].rollout_buffer)
        assert_same_observations(ours[0]._last_obs, theirs[0]._last_obs)
        np.testing.assert_array_equal(ours[0]._last_episode_starts, theirs[0]._last_episode_starts)
        for name in ("mean", "var", "count"):
            found, expected = (getattr(world.seen, name) for _, world, _ in (ours, theirs))
            np.testing.assert_allclose(found, expected, **CLOSE, err_msg=name)
        assert ours[0].num_timesteps == theirs[0].num_timesteps
    same_told(ours, theirs)


def states():
    """Two generators' states that are alike."""
    return [torch.get_rng_state()] * 2


def same_told(ours, theirs):
    """What the journal takes: returns, lengths and metrics of the episodes that ended."""
    found, expected = ours[2].ended, theirs[2].ended
    assert len(found) == len(expected) >= 10
    for a, b in zip(found, expected, strict=True):
        assert {"ate_m", "rmse_m", "mean_nees", "in_bounds", "divergence"} <= set(a)
        for key in ("ate_m", "rmse_m", "mean_nees", "in_bounds", "divergence"):
            assert a[key] == b[key]
        assert [a["episode"][k] for k in "rl"] == [b["episode"][k] for k in "rl"]
    assert [e["r"] for e in ours[0].ep_info_buffer] == [e["r"] for e in theirs[0].ep_info_buffer]


@pytest.mark.parametrize(
    ("changes", "passes"),
    [
        ({}, 2),
        ({"batch_size": 1049}, 2),  # the last batch is one row alone, which can't be normalized
        ({"clip_range": 0.004}, 2),  # many ratios are clipped
        ({"target_kl": 1e-5, "n_epochs": 9}, None),  # it stops early
        ({"ent_coef": 0.5, "max_grad_norm": 0.01, "hidden": (9, 8, 7)}, 2),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["truth", "frames"])
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch")
def test_updates_are_those_of_stable_baselines3(kind, changes, passes, monkeypatch):
    """From the same rollout, in the same order."""
    monkeypatch.setitem(RECIPES, kind, replace(RECIPES[kind], **{"target_kl": 1e9, **changes}))
    ours, _, listener = begun(kind, fast=True)
    theirs, _, _ = begun(kind, fast=False)
    rng = np.random.default_rng(0)
    for _ in range(2):  # the second goes on with the optimizer of the first
        collect(ours, listener)
        fill(theirs.rollout_buffer, ours.rollout_buffer)
        seed, told = int(rng.integers(2**31)), []
        for model in (ours, theirs):
            before = model._n_updates
            np.random.seed(seed)  # noqa: NPY002  it shuffles the batches
            model.train()
            assert passes in (None, model._n_updates - before)
            told.append(dict(model.logger.name_to_value))
        assert told[0].keys() == told[1].keys()
        for key, expected in told[1].items():
            assert told[0][key] == pytest.approx(expected, rel=1e-4, abs=1e-5), key
        for (name, a), (_, b) in zip(
            ours.policy.named_parameters(), theirs.policy.named_parameters(), strict=True
        ):
            np.testing.assert_allclose(a.detach(), b.detach(), **CLOSE, err_msg=name)
    assert passes or ours._n_updates == theirs._n_updates < 2 * 9
    if "clip_range" in changes:
        assert 0.05 < told[0]["train/clip_fraction"] < 0.95


def fill(theirs, ours):
    """Copy a rollout."""
    theirs.reset()
    for name in ("observations", "actions", "rewards", "episode_starts", "values", "log_probs",
                 "advantages", "returns"):  # fmt: skip
        getattr(theirs, name)[:] = getattr(ours, name)
    theirs.pos, theirs.full = ours.pos, True


def test_a_network_with_a_memory_learns_by_its_own_loop():
    recipe = replace(RECIPE, lstm=4, hidden=(8,))
    assert type(learner(TrainingEnv(TASK, recipe), recipe, 0)) is RecurrentPPO


def test_a_saved_model_is_one_of_stable_baselines3(tmp_path):
    ours, _, listener = begun("truth", fast=True)
    collect(ours, listener)
    ours.train()
    ours.save(tmp_path / "model.zip")
    found = PPO.load(tmp_path / "model.zip", device="cpu")
    seen = ours._last_obs
    np.testing.assert_array_equal(
        found.predict(seen, deterministic=True)[0], ours.predict(seen, deterministic=True)[0]
    )
    state = found.policy.optimizer.state_dict()["state"]
    assert len(state) == len(list(found.policy.parameters()))


@pytest.mark.slow
def test_short_trainings_end_where_those_of_stable_baselines3_do(tmp_path, monkeypatch):
    """The mean tuning reward over seeds lies in the 95 % interval of Stable-Baselines3's loop."""
    recipe = read_hyperparameters(shipped_hyperparameters("ppo"), "ppo")
    task = replace(TASK, banks={"handset": Bank(default_modes("handset"))})
    rewards = {}
    for loop, fast in (("ours", True), ("theirs", False)):
        monkeypatch.setattr(ppo, "learner", partial(learner, fast=fast))
        rewards[loop] = []
        for seed in range(4):
            folder = tmp_path / f"{loop}-{seed}"
            job = Job(task, recipe, "ppo", seed, 12 * 256 * 64, folder, "mmwave-loc train", 100)
            ppo.PpoTraining(job, lambda *_: None).run()
            *_, last = csv.DictReader(io.StringIO((folder / "progress.csv").read_text()))
            rewards[loop].append(float(last["tuning/reward"]))
    theirs = np.array(rewards["theirs"])
    half = 3.182 * theirs.std(ddof=1) / 2.0  # Student's t of three degrees of freedom
    assert abs(np.mean(rewards["ours"]) - theirs.mean()) < half, rewards
    assert half < 0.02  # or it would say little: the paper's rule is 0.3 below
