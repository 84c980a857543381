"""Rollout policy iteration as a training: files, seeds, interruptions and what it learns."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from experiments.training.hyperparameters import RolloutHyperparameters
from experiments.training.job import Job
from experiments.training.rollouts import RolloutTraining
from experiments.training.training_task import TrainingTask
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.mode_files import default_modes
from mmwave_env.reward import TrackingReward
from policies import LearnedSwitch
from tests.training.test_rollout_env import PLACES, task

pytestmark = pytest.mark.torch

HYPER = RolloutHyperparameters(
    num_envs=16, horizon=3, gamma=0.95, stride=2, states=64, memory=200, gradient_steps=3,
    batch_size=64, learning_rate=0.01, ent_coef=0.002, final_fraction=0.1, hidden=(8, 8),
    clip_observation=6.0, first_action_bias=0.0,
)  # fmt: skip
UPDATES = 10


def job_of(folder, of=None, hyper=HYPER, **changes):
    timesteps = UPDATES * hyper.states
    job = Job(of or task(), hyper, 0, timesteps, folder, "mmwave-loc train", 1, 16)
    return replace(job, **changes)


def silent(*_):
    pass


def train(job, tell=silent):
    return RolloutTraining(job, tell).run()


class Interrupted(Exception):
    pass


def interrupt_after(news):
    """Takes news until there were some, and then ends the training."""
    left = iter(range(news))

    def tell(*_):
        if next(left, None) is None:
            raise Interrupted

    return tell


def progress(folder):
    """Rows of the log, as text, without wall time."""
    rows = list(csv.DictReader(io.StringIO((folder / "progress.csv").read_text())))
    assert all(float(row.pop("seconds")) > 0.0 for row in rows)
    return rows


def outcome(folder):
    told = json.loads((folder / "outcome.json").read_text())
    told.pop("seconds")
    (told["beat_rule"] or {}).pop("seconds", None)
    return told


def assert_same_training(found, expected):
    """All but what a clock tells."""
    for name in ("policy.safetensors", "latest.safetensors"):
        assert (found / name).read_bytes() == (expected / name).read_bytes()
    assert progress(found) == progress(expected) and outcome(found) == outcome(expected)
    assert not (found / "checkpoint.pt").exists()


def test_interrupted_it_goes_on_to_the_same_end(tmp_path):
    """Again and again, between updates and at an evaluation; the states remembered come round."""
    whole, job = job_of(tmp_path / "whole"), job_of(tmp_path / "part", checkpoint_every=2)
    train(whole)
    for news in (3, 2, 4):
        with pytest.raises(Interrupted):
            train(job, interrupt_after(news))
        assert job.checkpoint.exists()
    train(job)
    assert_same_training(job.folder, whole.folder)


def test_trainings_differ_by_their_seeds_alone(tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(job_of(tmp_path / name, seed=seed))
    assert_same_training(tmp_path / "a", tmp_path / "b")
    a, c = ((tmp_path / name / "latest.safetensors").read_bytes() for name in "ac")
    assert a != c


def test_the_policy_file_acts_as_the_network(tmp_path):
    training = RolloutTraining(job_of(tmp_path), silent)
    training.run()
    env, learner = training.env, training.learner
    policy = LearnedSwitch(tmp_path / "latest.safetensors", env.observation)
    assert policy.card.timesteps >= UPDATES * HYPER.states and policy.card.algorithm == "rollouts"
    assert set(policy.card.banks) == {place.radio for place in PLACES}
    alike, taken = [], set()
    for _ in range(100):
        actions = learner.greedy(env.observations)
        alike.append(actions == policy(env.observations))
        taken |= set(actions.tolist())
        env.step(actions)
    assert np.mean(alike) > 0.999 and len(taken) > 1


# --- what it learns

QUICK = replace(
    HYPER, num_envs=128, horizon=8, states=4096, memory=40_000, gradient_steps=40,
    batch_size=1024, learning_rate=0.002, hidden=(32, 32), first_action_bias=1.0,
)  # fmt: skip


@pytest.mark.slow
def test_a_short_training_beats_the_rule_and_the_imm_from_scratch(tmp_path):
    """Over the modes of the rule, whose IMM is the plain one: it starts level with that."""
    modes = Bank(default_modes("handset"))
    street = TrainingTask(
        "mixed", PLACES[:1], {"handset": modes}, "full", TrackingReward(), "per-mode"
    )
    best = train(job_of(tmp_path, street, QUICK, timesteps=60_000, episodes=500))["best"]
    for rival in ("speed-rule", "imm"):
        low, high = best[f"minus {rival}"]["ci95"]
        assert 0.0 < low < high
