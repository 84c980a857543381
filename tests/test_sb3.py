"""The adapter for Stable-Baselines3: its own vector environment, and advantages by hand."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import mmwave_env  # noqa: F401  registers the environment

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecNormalize

from mmwave_env.sb3 import SB3VecEnv
from tests.marks import representative
from tests.training.actors import FEATURES, MODES

pytestmark = pytest.mark.torch

ID = "MmWaveLoc-v0"


def native(n=4, **arguments):
    arguments = {"modes": MODES, "episode_steps": 6} | arguments
    return gym.make_vec(ID, num_envs=n, autoreset_mode="SameStep", **arguments)


# --- what follows the end of an episode


class Clocks(gym.vector.VectorEnv):
    """Environment i shows (i, time); odd ones terminate and even ones are truncated after 2 + i."""

    num_envs = 4
    single_observation_space = gym.spaces.Box(-1e3, 1e3, (2,), np.float32)
    single_action_space = gym.spaces.Discrete(2)

    def __init__(self):
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def reset(self, *, seed=None, options=None):
        self.time = np.zeros(4)
        return self.shown(), {}

    def step(self, actions):
        self.time += 1
        rewards = 1.0 + 0.1 * self.time
        final_obs, numbers = np.full(4, None, object), np.arange(4)
        over = self.time == 2 + numbers
        for i in np.flatnonzero(over):
            final_obs[i] = self.shown()[i]
        self.time[over] = 0
        infos = {"final_obs": final_obs, "_final_obs": over, "final_info": {}, "_final_info": over}
        return self.shown(), rewards, over & (numbers % 2 == 1), over & (numbers % 2 == 0), infos

    def shown(self):
        return np.stack([np.arange(4), self.time], axis=1).astype(np.float32)


WRONG = {
    "flag": lambda info, now: {"TimeLimit.truncated": not info["TimeLimit.truncated"]},
    "never": lambda info, now: {"TimeLimit.truncated": False},
    "next": lambda info, now: {"terminal_observation": now},
}


class Untruthful(SB3VecEnv):
    """Ends are told in a wrong way."""

    def __init__(self, env, how):
        super().__init__(env)
        self.how = how

    def step_wait(self):
        now, rewards, over, infos = super().step_wait()
        for i in np.flatnonzero(over):
            infos[i] |= WRONG[self.how](infos[i], now[i])
        return now, rewards, over, infos


GAMMA, LAMBDA, STEPS = 0.9, 0.8, 23


def worth(number, time):
    """What the critic of these tests thinks of an observation."""
    return 2.0 - 0.5 * number + 0.25 * time


def advantages_of(number):
    """(STEPS,) of environment ``number``: GAE (Schulman et al. 2016, eq. 16), step by step."""
    deltas, ends, time = [], [], 0
    for _ in range(STEPS):
        over = time + 1 == 2 + number
        after = 0.0 if over and number % 2 else worth(number, time + 1)
        deltas.append(1.0 + 0.1 * (time + 1) + GAMMA * after - worth(number, time))
        ends.append(over)
        time = 0 if over else time + 1
    found, last = [], 0.0
    for delta, over in zip(reversed(deltas), reversed(ends), strict=True):
        last = delta + (0.0 if over else GAMMA * LAMBDA * last)
        found.insert(0, last)
    return found


def collected(env):
    """The rollout buffer of PPO after one rollout, with a critic that `worth` describes."""
    model = PPO(
        "MlpPolicy", env, n_steps=STEPS, batch_size=STEPS, gamma=GAMMA, gae_lambda=LAMBDA, seed=0,
        device="cpu", policy_kwargs={"net_arch": []},
    )  # fmt: skip
    with torch.no_grad():
        model.policy.value_net.weight[:] = torch.tensor([[-0.5, 0.25]])
        model.policy.value_net.bias[:] = 2.0
    _, callback = model._setup_learn(0, CallbackList([]))
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, STEPS)
    return model.rollout_buffer


@pytest.mark.slow
def test_values_follow_a_truncated_episode_but_not_a_terminated_one():
    buffer = collected(SB3VecEnv(Clocks()))
    expected = np.transpose([advantages_of(number) for number in range(4)])
    np.testing.assert_allclose(buffer.advantages, expected, rtol=1e-5, atol=1e-5)
    numbers, times = np.moveaxis(buffer.observations, -1, 0)
    values = worth(numbers, times)
    np.testing.assert_allclose(buffer.returns, expected + values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("how", WRONG)
def test_advantages_would_show_ends_that_are_told_wrongly(how):
    buffer = collected(Untruthful(Clocks(), how))
    expected = np.transpose([advantages_of(number) for number in range(4)])
    assert np.abs(buffer.advantages - expected).max() > 0.1


# --- against single environments

CONFIGURATIONS = {
    "truncated": {},
    "ends early": {
        "episode_steps": 20, "terminate_on_divergence": True, "scenario": "vehicle",
        "modes": MODES[:1],  # which loses a vehicle
    },
    "log score": {"observation": "prior", "reward": "log-score", "odometry": True},
}  # fmt: skip


def assert_same(found, expected):
    """Two infos tell the same; of an ``episode`` all but the wall time, to single precision."""
    found, expected = dict(found), dict(expected)
    ours, theirs = found.pop("episode", None), expected.pop("episode", None)
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        np.testing.assert_array_equal(found[key], value, err_msg=key)
    assert (ours is None) == (theirs is None)
    if ours:
        assert ours.keys() == theirs.keys() and ours["l"] == theirs["l"] and ours["t"] >= 0.0
        assert ours["r"] == pytest.approx(theirs["r"], rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("configuration", representative(CONFIGURATIONS, "ends early"))
def test_it_is_what_stable_baselines3_makes_of_single_environments(configuration):
    arguments = {"modes": MODES, "episode_steps": 6} | CONFIGURATIONS[configuration]
    keys = ("position_error_m", "truth", "accepted")
    ours = SB3VecEnv(native(4, **arguments), keys)
    theirs = DummyVecEnv([lambda: Monitor(gym.make(ID, **arguments))] * 4)
    rng, ended, ways = np.random.default_rng(1), np.zeros(4, int), set()
    for venv in (ours, theirs):
        venv.seed(7)
    found, expected = ours.reset(), theirs.reset()
    np.testing.assert_array_equal(found, expected)
    for _ in range(100):
        actions = rng.integers(ours.action_space.n, size=4)
        (found, *scores, infos), (expected, *their_scores, their_infos) = (
            venv.step(actions) for venv in (ours, theirs)
        )
        for a, b in zip((found, *scores), (expected, *their_scores), strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
        for i, over in enumerate(scores[1]):
            if over:
                assert_same(infos[i], their_infos[i])
                ways.add(infos[i]["TimeLimit.truncated"])
            else:
                assert_same(infos[i], {key: their_infos[i][key] for key in keys})
        ended += scores[1]
    assert ended.min() >= 3
    assert ways == ({True, False} if configuration == "ends early" else {True})


def test_infos_of_any_vector_environment_are_told():
    """Gymnasium's own one batches nested infos, and some that not every environment tells."""

    class Talkative(gym.Wrapper):
        def step(self, action):
            observation, reward, _, truncated, _ = self.env.step(action)
            told = {"nested": {"action": int(action)}} | ({"rare": "yes"} if action else {})
            return observation, reward, False, truncated, {"always": reward} | told

    def make():
        return Talkative(gym.make("CartPole-v1", max_episode_steps=3))

    env = gym.vector.SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.SAME_STEP)
    venv = SB3VecEnv(env, ("nested", "rare"))
    venv.seed(0)
    venv.reset()
    for _ in range(2):
        infos = venv.step(np.array([0, 1]))[3]
        assert infos == [{"nested": {"action": 0}}, {"nested": {"action": 1}, "rare": "yes"}]
    *_, (one, other) = venv.step(np.array([0, 1]))
    assert (one["always"], one["nested"], one["episode"]["l"]) == (1.0, {"action": 0}, 3)
    assert "rare" not in one and other["rare"] == "yes" and other["TimeLimit.truncated"]


# --- seeds, options, attributes


def test_seeds_and_options_count_once():
    venv, env = SB3VecEnv(native()), native()
    venv.seed(3)
    venv.set_options({"reset_mask": np.ones(4, bool)})
    np.testing.assert_array_equal(venv.reset(), env.reset(seed=3)[0])
    np.testing.assert_array_equal(venv.reset(), env.reset()[0])
    venv.seed(3)
    np.testing.assert_array_equal(venv.reset(), env.reset(seed=[3, 4, 5, 6])[0])


def test_different_options_are_refused():
    venv = SB3VecEnv(native())
    venv.set_options([{"a": 1}, {}, {}, {}])
    with pytest.raises(ValueError, match="options: found .*'a': 1.*, expected the same everywh"):
        venv.reset()


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])
def test_other_autoreset_modes_are_refused(mode):
    env = gym.make_vec(ID, num_envs=2, autoreset_mode=mode, modes=MODES)
    with pytest.raises(ValueError, match=f"found '{mode}', expected \"SameStep\": gymnasium.make"):
        SB3VecEnv(env)


def test_an_environment_that_tells_no_autoreset_mode_is_refused():
    env = gym.vector.VectorEnv()
    with pytest.raises(ValueError, match="autoreset_mode: found None"):
        SB3VecEnv(env)


def test_attributes_and_methods_are_those_of_all():
    venv = SB3VecEnv(native())
    env = venv.env
    assert venv.get_attr("modes") == [MODES] * 4 and venv.get_attr("modes", [1, 2]) == [MODES] * 2
    assert venv.get_attr("num_envs", 0) == [4]
    assert not venv.has_attr("nothing")
    venv.set_attr("word", "x")
    assert env.word == "x"
    with pytest.raises(ValueError, match=r"set_attr\('word'\): found indices 1, expected all"):
        venv.set_attr("word", "y", 1)
    venv.reset()
    states = venv.env_method("state", indices=[0, 1, 2, 3])
    assert len(states) == 4 and all(state is states[0] for state in states)
    with pytest.raises(ValueError, match=r"env_method\('state'\): found indices \[0\], expected"):
        venv.env_method("state", indices=[0])
    assert venv.env_is_wrapped(Monitor) == [True] * 4
    assert venv.env_is_wrapped(gym.wrappers.TimeLimit, [2]) == [False]


def test_closing_closes_the_environment():
    venv = SB3VecEnv(native())
    venv.close()
    assert venv.env.closed


# --- what Stable-Baselines3 has to wrap around it


def test_its_wrappers_and_its_evaluation_work():
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):
        venv = VecMonitor(VecCheckNan(SB3VecEnv(native()), raise_exception=True))
    normal = VecNormalize(venv, norm_reward=False, clip_obs=6.0)
    model = PPO("MlpPolicy", normal, n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(128)
    assert len(model.ep_info_buffer) == 4 * (32 // 6)
    assert {info["l"] for info in model.ep_info_buffer} == {6}
    assert abs(normal.obs_rms.mean).max() > 0.0 and normal.obs_rms.count > 128

    normal.training = False
    normal.seed(0)
    rewards, lengths = evaluate_policy(model, normal, 8, return_episode_rewards=True)
    env, now = native(), None
    now = env.reset(seed=0)[0]
    returns, expected = np.zeros(4), []
    for _ in range(12):
        actions, _ = model.predict(normal.normalize_obs(now), deterministic=True)
        now, reward, _, truncated, _ = env.step(actions)
        returns += reward
        if truncated.all():
            expected += returns.tolist()
            returns[:] = 0.0
    assert lengths == [6] * 8
    assert rewards == pytest.approx(expected, rel=1e-5)


class Steady:
    """Always the same mode."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.ones(len(observation), int), state


def test_evaluation_reads_the_rewards_of_the_environment_as_from_a_monitor():
    """Without the warning (here an error) that there is none, whatever rewards wrappers show."""
    plain, normal = SB3VecEnv(native()), VecNormalize(SB3VecEnv(native()), norm_reward=True)
    found, expected = ([], [])
    for venv, returns in ((normal, found), (plain, expected)):
        venv.seed(0)
        returns += evaluate_policy(Steady(), venv, 4, return_episode_rewards=True)[0]
    assert found == expected


def test_terminal_observations_are_normalized_too():
    normal = VecNormalize(SB3VecEnv(native(2, episode_steps=3)), norm_reward=False)
    normal.training = False
    normal.obs_rms.mean, normal.obs_rms.var = np.full(FEATURES, 0.5), np.full(FEATURES, 4.0)
    env = native(2, episode_steps=3)
    normal.seed(1)
    normal.reset()
    env.reset(seed=1)
    for _ in range(3):
        *_, infos = normal.step(np.array([0, 2]))
        *_, told = env.step(np.array([0, 2]))
    for i in range(2):
        expected = (told["final_obs"][i] - 0.5) / np.sqrt(4.0 + normal.epsilon)
        np.testing.assert_allclose(infos[i]["terminal_observation"], expected, rtol=1e-5)


# --- stop and go on


def test_returns_and_lengths_go_on():
    first, second = SB3VecEnv(native()), SB3VecEnv(native())
    first.seed(0)
    first.reset()
    for _ in range(4):
        first.step(np.array([0, 1, 2, 0]))
    second.env.restore(first.env.state())
    second.restore(first.state())
    for _ in range(9):
        ended = [venv.step(np.array([2, 1, 0, 0]))[3] for venv in (first, second)]
        for a, b in zip(*ended, strict=True):
            assert [a.get("episode", {}).get(k) for k in "rl"] == [
                b.get("episode", {}).get(k) for k in "rl"
            ]
