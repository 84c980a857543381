"""Tests of training policies: hyperparameters, evaluations, options, folders, checkpoints."""

import io
import math
import re
import sys
from dataclasses import asdict, replace

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.damage import Malicious, damaged
from tests.paths import json_in, write_json
from tests.refusals import refuses

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3.common.vec_env import VecNormalize

from experiments.train import Args, main
from experiments.training.hyperparameters import (
    KINDS,
    PpoHyperparameters,
    falling,
    hyperparameters,
    read_hyperparameters,
    shipped_hyperparameters,
)
from experiments.training.ppo import PlacesVecEnv, learner
from experiments.training.run import manifest_of, train
from experiments.training.trainer import Job, Progress, read_checkpoint
from experiments.training.training_task import Place, TrainingTask
from mmwave_env.filters.bank import Bank, default_modes
from mmwave_env.interface.reward import TrackingReward
from policies.policy_file import read_policy
from tests.cli import command, succeed
from tests.training.actors import MODES

pytestmark = pytest.mark.torch

PLACES = ("street:handset", "o1:standard:0.5")  # scene:radio or scene:radio:time step in s
STREET = Place("street", "handset")
TASK = TrainingTask("mixed", (STREET,), {"handset": Bank(MODES)}, "full", TrackingReward())
HYPER = PpoHyperparameters(
    num_envs=8, n_steps=16, batch_size=64, n_epochs=2, learning_rate=0.003, ent_coef=0.01,
    final_fraction=0.1, gamma=0.95, gae_lambda=0.9, clip_range=0.2, max_grad_norm=0.5,
    target_kl=0.1, hidden=(8, 8), clip_observation=5.0, paired=False,
)  # fmt: skip


def job_of(folder, **changes):
    job = Job(TASK, HYPER, 0, 1000, folder, "mmwave-loc train", 20)
    return replace(job, **changes)


def content(hyper=HYPER):
    """Return hyperparameters in the form that a file of hyperparameters has."""
    return asdict(hyper) | {"hidden": list(hyper.hidden)}


def test_a_training_reports_its_periodic_evaluations(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.training.ppo.PpoTrainer.EVERY", 2)
    heard = []
    outcome = train(job_of(tmp_path), lambda *news: heard.append(news))
    rewards = {steps: float(text.rpartition("reward ")[2]) for steps, text in heard if text}
    assert len(rewards) > 1 and max(rewards) == outcome["timesteps"] == 1024
    best = outcome["best"]
    assert rewards[best["timesteps"]] == max(rewards.values()) == round(best["reward"], 3)


# --- hyperparameters


@pytest.mark.parametrize("left", [1.0, 0.5, 0.0, -0.01, -0.5, -16_000.0])
def test_learning_rates_fall_but_stay_positive_after_the_end_of_training(left):
    rate = falling(0.1, left)
    assert rate == pytest.approx(max(0.1 + 0.9 * left, 0.05))


def test_a_bias_makes_the_first_action_more_likely_at_the_start():
    env = VecNormalize(PlacesVecEnv(TASK, HYPER), norm_reward=False)
    models = [learner(env, replace(HYPER, first_action_bias=bias), seed=1) for bias in (0.0, 2.0)]
    observed = torch.as_tensor(env.reset())
    logits = [model.policy.get_distribution(observed).distribution.logits for model in models]
    odds = [each[:, :1] - each[:, 1:] for each in logits]
    torch.testing.assert_close(odds[1] - odds[0], torch.full_like(odds[0], 2.0))


def test_hyperparameters_that_have_a_default_may_be_left_out(tmp_path):
    path = written(tmp_path / "old.json", {"first_action_bias": None})
    assert read_hyperparameters(path, "ppo") == HYPER


BAD = {  # name -> change or text of the file, expected message
    "text": ("gamma: 0.9\n", "Expecting value"),
    "missing": ({"gamma": None}, "gamma: found none, expected one in addition to num_envs"),
    "unknown": ({"gama": 0.9}, "key: found 'gama', did you mean gamma"),
    "nan": ({"gamma": math.nan}, "gamma: found nan, expected a number"),
    "fraction": ({"n_steps": 1.5}, "n_steps: found 1.5, expected an integer from 1 to"),
    "not a bool": ({"paired": 1}, "paired: found 1, expected bool"),
    "too small": ({"batch_size": 1}, "batch_size: found 1, expected an integer from 2 to"),
    "no neurons": ({"hidden": [64, 0]}, r"hidden\[1\]: found 0, expected an integer from 1 to"),
}


def written(path, change):
    """Write a text, or HYPER with changes (None removes an entry), to a file; return its path."""
    if isinstance(change, str):
        path.write_text(change)
    else:
        changed = content() | change
        write_json(path, {k: v for k, v in changed.items() if v is not None})
    return path


def refused(*words):
    """Run ``mmwave-loc train`` with options that it must refuse; return the last line of stderr."""
    done = command("train", *words)
    line = done.stderr.splitlines()[-1]
    assert done.returncode == 2 and done.stdout == "" and line.startswith("mmwave-loc train: ")
    return line


@pytest.mark.parametrize("change", BAD)
def test_a_bad_hyperparameter_is_refused_in_one_line(change, tmp_path):
    changes, message = BAD[change]
    path = written(tmp_path / "mine.json", changes)
    out = tmp_path / "run"
    line = refused("--hyperparameters", path, "--out", out)
    assert str(path) in line and not out.exists()
    assert re.search(message, line), line


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--radio", "high", "--places", "o1:high"), "radio: cannot be combined with places"),
        (("--beliefs", "permode"), "permode.*--beliefs.*per-mode"),
        (("--beliefs", "per-mode", "--modes", "ukf"), "modes: found only 'ukf'"),
        (("--seeds", 0), "seeds: found 0"),
        (("--total-timesteps", -1), "total_timesteps: found -1"),
        (("--algo", "rollouts", "--hyperparameters", shipped_hyperparameters("ppo")),
         "key: found 'n_steps', .*num_envs"),
    ],
)  # fmt: skip
def test_wrong_options_are_refused_before_a_folder_is_made(words, message, tmp_path):
    line = refused(*words, "--out", tmp_path / "run")
    assert re.search(message, line), line
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(("algorithm", "count"), [*((kind, 1) for kind in KINDS), ("rollouts", 20)])
def test_too_few_environments_are_refused_before_a_folder_is_made(algorithm, count, tmp_path):
    shipped = json_in(shipped_hyperparameters(algorithm))
    path = write_json(tmp_path / "few.json", shipped | {"num_envs": count})
    out = tmp_path / "run"
    with refuses(path, "num_envs"):
        main(Args(algo=algorithm, hyperparameters=path, places=PLACES, out=out))
    assert not out.exists()


def test_the_error_without_pytorch_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "experiments.training.run", None)  # hides PyTorch
    assert "mmwave-loc[train]" in refused("--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


# --- folders, and a short run


def folder_of(path, modes=None, hyper=None, **options):
    """Make the folder of a run whose manifest (run.json) has these options; return the path."""
    args = Args(out=path, **options)
    banks = {"handset": Bank(modes or default_modes("handset"))}
    manifest = manifest_of(args, banks, hyper or hyperparameters(args, 1))
    path.mkdir(exist_ok=True)
    write_json(path / "run.json", manifest)
    return path


def test_a_run_is_not_overwritten_by_accident(tmp_path):
    line = refused("--out", folder_of(tmp_path))
    assert "found files in" in line and "--resume" in line


def test_a_run_with_other_options_is_not_resumed(tmp_path):
    line = refused("--out", folder_of(tmp_path), "--resume", "--seeds", 6)
    assert "run.json: command: found mmwave-loc train, expected mmwave-loc train --seeds 6;" in line


def test_a_run_with_other_modes_banks_or_hyperparameters_is_not_resumed(tmp_path):
    path = written(tmp_path / "mine.json", {})
    resume = ("--resume", "--hyperparameters", path, "--out")
    folder = folder_of(tmp_path / "modes", modes=MODES, hyperparameters=path)
    assert "modes: found [{'name': 'stand'" in refused(*resume, folder)
    folder = folder_of(tmp_path / "gamma", hyper=replace(HYPER, gamma=0.5), hyperparameters=path)
    assert "gamma: found 0.5, expected 0.95" in refused(*resume, folder)
    folder = folder_of(tmp_path / "banks", beliefs="per-mode", modes=MODES)
    line = refused("--beliefs", "per-mode", "--out", folder, "--resume")
    assert "banks: found {'handset': {'modes': [{'name': 'stand'" in line


@pytest.mark.parametrize("damaged", ["", "[]", "{}", '{"modes": 2, "hyperparameters": 3}'])
def test_a_damaged_manifest_is_refused(damaged, tmp_path):
    (tmp_path / "run.json").write_text(damaged)
    line = refused("--out", tmp_path, "--resume")
    assert "run.json: not the manifest of a run" in line


@pytest.mark.slow
def test_a_policy_trained_at_two_places_with_beliefs_per_mode_plays_at_a_third(tmp_path):
    """Run the command ``train``, then the command ``compare``."""
    short = ("--seeds", 1, "--total-timesteps", 1, "--out", tmp_path / "run")
    shown = succeed("train", "--beliefs", "per-mode", "--places", *PLACES, *short)
    assert "| minus imm-best |" in shown
    (outcome,) = json_in(tmp_path / "run/summary.json")["seeds"]
    best = outcome["best"]
    assert {"minus speed-rule", "minus imm", "minus imm-best"} <= best.keys()
    assert abs(best["minus imm-best"]["mean"]) < 0.05  # the policy starts near the IMM

    policy = tmp_path / "run/policy.safetensors"
    card = read_policy(policy).card
    assert card.beliefs == "per-mode" and list(card.banks) == ["handset", "standard"]
    words = ("--radio", "high", "--scene", "dynamic-doppler", "--episodes", 5)
    assert f"| {policy} |" in succeed("compare", "--policies", policy, *words)


# --- checkpoints, which may be valid, damaged or forged

PROGRESS = Progress(3, 96, 1.5, [{"timesteps": 96, "seconds": 1.5}], {"reward": -1.5})


def checkpoint(path, trainer):
    """Write a checkpoint with a trainer's state to a file; return the path."""
    memory = io.BytesIO()
    torch.save({"progress": vars(PROGRESS), "trainer": trainer}, memory)
    path.write_bytes(memory.getvalue())
    return path


@settings(
    max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_a_damaged_checkpoint_is_read_or_refused(tmp_path, data):
    path = checkpoint(tmp_path / "checkpoint.pt", {"weight": torch.ones(2, 2)})
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        read_checkpoint(path)
    except ValueError as error:
        refusal = str(error)
    else:
        return
    assert "checkpoint.pt: not a checkpoint: " in refusal


def test_a_checkpoint_that_lacks_entries_of_the_trainer_is_refused(tmp_path):
    job = job_of(tmp_path)
    checkpoint(job.checkpoint, {"timesteps": 3})
    with refuses("checkpoint.pt", "network"):
        train(job, lambda *_: None)


def test_a_malicious_checkpoint_is_refused_and_not_executed(tmp_path):
    trap = tmp_path / "trap"
    path = checkpoint(tmp_path / "checkpoint.pt", Malicious(trap))
    with refuses("checkpoint.pt"):
        read_checkpoint(path)
    assert not trap.exists()
