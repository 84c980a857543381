"""Tests of the conversion of models of Stable-Baselines3 to policy files."""

import base64
import builtins
import json
import pickle
import zipfile
from multiprocessing import get_context

import gymnasium as gym
import numpy as np
import pytest

import mmwave_env  # noqa: F401  registers the environment
from tests.cli import assert_one_clear_line, command, succeed
from tests.damage import Malicious
from tests.refusals import refuses
from tests.training.actors import HANDSET, MODES

pytest.importorskip("stable_baselines3")

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import VecNormalize

from experiments.training import unzip
from experiments.training.actor import actor_tensors
from mmwave_env.filters.bank import as_written, bank_as_written
from mmwave_env.sb3 import SB3VecEnv
from policies import LearnedSwitch

pytestmark = pytest.mark.torch

FEW = {"n_steps": 8, "batch_size": 32}
ALGORITHMS = {
    "ppo": (PPO, "MlpPolicy", FEW),
    "no layers": (PPO, "MlpPolicy", FEW | {"policy_kwargs": {"net_arch": []}}),
    "a2c": (A2C, "MlpPolicy", {}),
    "maskable": (MaskablePPO, "MlpPolicy", FEW),
}


@pytest.fixture
def forked(monkeypatch):
    """Load models in a fork of this process, because starting a new process takes seconds."""
    monkeypatch.setattr(unzip, "get_context", lambda how: get_context("fork"))


@pytest.fixture
def modes(tmp_path):
    """Return a mode file with three modes that are quick to compile."""
    path = tmp_path / "modes.json"
    path.write_text(json.dumps({"modes": [as_written(mode) for mode in MODES]}))
    return path


def environment(normalized=False, **arguments):
    arguments = {"modes": MODES, "episode_steps": 6, "autoreset_mode": "SameStep"} | arguments
    native = gym.make_vec("MmWaveLoc-v0", num_envs=4, **arguments)
    env = SB3VecEnv(native)
    return VecNormalize(env, norm_reward=False, clip_obs=3.0) if normalized else env


def trained(kind, env):
    """Return a model that was trained for a few steps; its actions depend on the observations."""
    algorithm, policy, options = ALGORITHMS[kind]
    model = algorithm(policy, env, seed=1, **options)
    model.learn(32, **{"use_masking": False} if kind == "maskable" else {})
    with torch.no_grad():
        model.policy.action_net.weight *= 100.0
    return model


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("normalized", [False, True], ids=["raw", "normalized"])
@pytest.mark.parametrize("kind", ALGORITHMS)
def test_a_converted_model_still_chooses_the_same_actions(kind, normalized, tmp_path, modes):
    """Compare actions in 50 steps, which include ends of episodes."""
    env = environment(normalized)
    model = trained(kind, env)
    words = []
    model.save(tmp_path / "model.zip")
    if normalized:
        env.save(str(tmp_path / "normal.pkl"))
        words = ["--normalize", tmp_path / "normal.pkl"]
        env.training = False
    out = tmp_path / "policy.safetensors"
    shown = succeed("convert", tmp_path / "model.zip", out, "--modes", modes, *words)
    assert "on 1000 of 1000 observations" in shown
    policy = LearnedSwitch(out)
    assert policy.modes == MODES and policy.card.timesteps == model.num_timesteps
    assert policy.card.command.startswith(f"mmwave-loc convert {tmp_path / 'model.zip'} {out} --")
    observed = env.reset()
    state = None
    begins = np.ones(4, bool)
    taken = set()
    for _ in range(50):
        actions, state = model.predict(observed, state, begins, deterministic=True)
        policy.reset(begins)
        raw = env.get_original_obs() if normalized else observed
        np.testing.assert_array_equal(policy(raw), actions)
        taken |= set(actions.tolist())
        observed, _, begins, _ = env.step(actions)
    assert len(taken) > 1


@pytest.mark.usefixtures("forked")
def test_a_model_for_beliefs_per_mode_is_converted_with_its_bank(tmp_path):
    bank = tmp_path / "bank.json"
    model = tmp_path / "trusting.zip"
    bank.write_text(json.dumps(bank_as_written(HANDSET)))
    trained("ppo", environment(beliefs="per-mode", modes=HANDSET)).save(model)
    out = tmp_path / "policy.safetensors"
    shown = succeed("convert", model, out, "--beliefs", "per-mode", "--modes", bank)
    assert "on 1000 of 1000 observations" in shown
    card = LearnedSwitch(out).card
    assert card.beliefs == "per-mode" and card.banks == {"handset": HANDSET}


def with_a_trap(file, trap):
    """Add an object to a model's file; loading the file then runs code of this object."""
    with zipfile.ZipFile(file) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(content["data"])
    pickled = base64.b64encode(pickle.dumps(Malicious(trap))).decode()
    data["extra"] = {":type:": "Malicious", ":serialized:": pickled}
    with zipfile.ZipFile(file, "w") as archive:
        for name, part in (content | {"data": json.dumps(data).encode()}).items():
            archive.writestr(name, part)


@pytest.mark.slow
def test_code_in_a_model_never_runs_in_the_converting_process(tmp_path, modes):
    file = tmp_path / "model.zip"
    trap = tmp_path / "trap"
    trained("ppo", environment()).save(file)
    with_a_trap(file, trap)
    succeed("convert", file, tmp_path / "policy.safetensors", "--modes", modes)
    assert trap.exists() and not hasattr(builtins, "touched")
    LearnedSwitch(tmp_path / "policy.safetensors")


@pytest.mark.usefixtures("forked")
def test_a_process_that_ends_without_a_result_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(unzip, "_unzip", print)  # the process writes no file of tensors
    with refuses("model.zip"):
        unzip.unzipped(tmp_path / "model.zip", None)


def layered(**changes):
    """Return a PPO model whose network differs from the default by these changes."""
    return PPO("MlpPolicy", environment(), **FEW, policy_kwargs=changes)


def normalized():
    return trained("ppo", environment(normalized=True))


MISTAKES = {  # name -> function that makes a model, options, expected message
    "not a zip": (None, (), "model.zip: not a model"),
    "relu": (lambda: layered(activation_fn=torch.nn.ReLU), (), "model.zip: network: found"),
    "q network": (lambda: DQN("MlpPolicy", environment(), buffer_size=100), (), "network: found"),
    "features": (lambda: trained("ppo", environment()), ("--observation", "prior"), "features"),
    "normalized without statistics": (normalized, (), "model.zip: normalize: found none"),
    "wrong statistics file": (normalized, ("--normalize", "MODES"), "not a file of VecNormalize"),
}


@pytest.mark.usefixtures("forked")
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_model_that_cannot_become_a_policy_file_is_refused(mistake, tmp_path, modes):
    make, words, message = MISTAKES[mistake]
    file = tmp_path / "model.zip"
    out = tmp_path / "policy.safetensors"
    if make is None:
        file.write_text("no zip")
    else:
        make().save(file)
    words = [modes if word == "MODES" else word for word in words]
    done = command("convert", file, out, "--modes", modes, *words)
    assert_one_clear_line(done, f"^mmwave-loc convert: .*{message}")
    assert not out.exists()


@pytest.mark.usefixtures("forked")
def test_a_model_is_refused_if_its_extracted_layers_act_differently(tmp_path, modes, monkeypatch):
    """Change the last of the extracted layers, so that the layers and the model act differently."""
    file = tmp_path / "model.zip"
    trained("ppo", environment()).save(file)

    def turned(*of):
        tensors = actor_tensors(*of)
        return tensors | {"layer.2.weight": -tensors["layer.2.weight"]}

    monkeypatch.setattr(unzip, "actor_tensors", turned)
    done = command("convert", file, tmp_path / "policy.safetensors", "--modes", modes)
    assert_one_clear_line(done, r"alone choose the same action as the model for \d+ of 1000 obs")
