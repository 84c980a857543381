"""Tests of policy files of models that were trained with Stable-Baselines3."""

import gymnasium as gym
import numpy as np
import pytest

import mmwave_env  # noqa: F401  registers the environment
from tests.refusals import refuses
from tests.training.actors import HANDSET, MODES

pytest.importorskip("stable_baselines3")

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import VecNormalize

from mmwave_env.sb3 import SB3VecEnv
from policies import LearnedSwitch, save_sb3

pytestmark = pytest.mark.torch

FEW = {"n_steps": 8, "batch_size": 32}
ALGORITHMS = {
    "ppo": (PPO, FEW),
    "no layers": (PPO, FEW | {"policy_kwargs": {"net_arch": []}}),
    "a2c": (A2C, {}),
    "maskable": (MaskablePPO, FEW),
}


def environment(normalized=False, **arguments):
    arguments = {"modes": MODES, "episode_steps": 6, "autoreset_mode": "SameStep"} | arguments
    env = SB3VecEnv(gym.make_vec("MmWaveLoc-v0", num_envs=4, **arguments))
    return VecNormalize(env, norm_reward=False, clip_obs=3.0) if normalized else env


def trained(kind, env):
    """Return a model that was trained for a few steps; its actions depend on the observations."""
    algorithm, options = ALGORITHMS[kind]
    model = algorithm("MlpPolicy", env, seed=1, **options)
    model.learn(32, **{"use_masking": False} if kind == "maskable" else {})
    with torch.no_grad():
        model.policy.action_net.weight *= 100.0
    return model


@pytest.mark.parametrize("normalized", [False, True], ids=["raw", "normalized"])
@pytest.mark.parametrize("kind", ALGORITHMS)
def test_a_policy_file_chooses_the_same_actions_as_its_model(kind, normalized, tmp_path):
    """Compare actions in 50 steps, which include ends of episodes."""
    env = environment(normalized)
    model = trained(kind, env)
    save_sb3(model, tmp_path / "policy.safetensors")
    policy = LearnedSwitch(tmp_path / "policy.safetensors")
    assert policy.modes == MODES and policy.card.timesteps == model.num_timesteps
    if normalized:
        env.training = False
    observed = env.reset()
    taken = set()
    for _ in range(50):
        actions, _ = model.predict(observed, deterministic=True)
        raw = env.get_original_obs() if normalized else observed
        np.testing.assert_array_equal(policy.act(raw), actions)
        taken |= set(actions.tolist())
        observed, _, _, _ = env.step(actions)
    assert len(taken) > 1


def test_the_file_of_a_model_for_beliefs_per_mode_has_its_bank(tmp_path):
    model = trained("ppo", environment(beliefs="per-mode", modes=HANDSET))
    save_sb3(model, tmp_path / "policy.safetensors")
    card = LearnedSwitch(tmp_path / "policy.safetensors").card
    assert card.beliefs == "per-mode" and card.banks == {"handset": HANDSET}


def test_a_model_loaded_with_a_single_environment_is_saved(tmp_path):
    env = gym.make("MmWaveLoc-v0", modes=MODES, observation="prior", scenario="vehicle")
    PPO("MlpPolicy", env, n_steps=32, batch_size=32).save(tmp_path / "model.zip")
    save_sb3(PPO.load(tmp_path / "model.zip", env=env), tmp_path / "policy.safetensors")
    card = LearnedSwitch(tmp_path / "policy.safetensors").card
    assert (card.observation, card.scenario, card.radio) == ("prior", "vehicle", "handset")


def without_environment(folder):
    PPO("MlpPolicy", environment(), **FEW).save(folder / "model.zip")
    return PPO.load(folder / "model.zip")


def acting_otherwise(folder):
    """Return a model that does more than apply layers."""
    model = trained("ppo", environment())
    predict = model.predict
    model.predict = lambda *given, **options: (2 - predict(*given, **options)[0], None)
    return model


def relu(folder):
    return PPO("MlpPolicy", environment(), **FEW, policy_kwargs={"activation_fn": torch.nn.ReLU})


def correcting(folder):
    return PPO("MlpPolicy", environment(beliefs="per-mode", action="correction"), **FEW)


MISTAKES = {  # function that makes a model -> beginning of the message
    without_environment: "model: found no environment",
    acting_otherwise: "model: its layers alone choose the same action",
    relu: "model: its layers alone choose the same action",
    correcting: "model: found .*Box",
    lambda folder: DQN("MlpPolicy", environment(), buffer_size=100): "model: found DQNPolicy",
}


@pytest.mark.parametrize("make", MISTAKES)
def test_a_model_that_cannot_become_a_policy_file_is_refused(make, tmp_path):
    with pytest.raises(ValueError, match=MISTAKES[make]):
        save_sb3(make(tmp_path), tmp_path / "policy.safetensors")
    assert not (tmp_path / "policy.safetensors").exists()


def test_a_name_with_another_ending_is_refused(tmp_path):
    with refuses("path"):
        save_sb3(None, tmp_path / "policy.zip")
