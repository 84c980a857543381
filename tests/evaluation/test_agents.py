"""Tests of `compare` with agents that a programmer wrote: objects, files or functions."""

import math
import sys

import gymnasium as gym
import numpy as np
import pytest

from experiments.evaluation.compare import compare
from experiments.evaluation.contenders import Contender, contender_from, draw_episodes
from experiments.evaluation.runner import run_contender
from mmwave_env.filters.bank import Bank, bank_as_written, modes_from
from mmwave_env.models.layout import Layout
from mmwave_env.task import task_from
from policies import Correction, Corrector, LearnedSwitch
from tests.cli import assert_refused, succeed
from tests.paths import write_json
from tests.refusals import refuses
from tests.training.actors import HANDSET, actor, card_of, write

OWN = '''
import numpy as np

class Second:
    """An agent that always chooses the second mode."""

    def __call__(self, observations):
        return np.ones(len(observations), int)

def first():
    return lambda observations: np.zeros(len(observations), int)

def second():
    return Second()

def seeing_priors():
    agent = Second()
    agent.modes, agent.observation = ["ekf", "ukf", "ckf"], "prior"
    return agent

def per_mode():
    agent = Second()
    agent.modes, agent.beliefs = ["ekf", "ckf"], "per-mode"
    return agent

def nothing():
    return None

def wrong():
    return lambda observations: np.ones(len(observations))

def beyond():
    return lambda observations: np.full(len(observations), 2)

def stumbling():
    def act(observations):
        raise RuntimeError(f"no idea\\nwhat {observations.shape} is")
    return act

def act(observations):
    return np.ones(len(observations), int)
'''


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Change to a folder that contains a module with a user's agents; return the folder."""
    (tmp_path / "my_agents.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    sys.modules.pop("my_agents", None)


TWO = ["ekf", "ukf"]  # fewer modes than usual, because they compile faster


class Upward:
    """An agent that has no method ``reset`` and shifts the height by one standard deviation."""

    beliefs = "per-mode"
    modes = TWO

    def __call__(self, observations):
        return np.zeros(len(observations), int)

    def correct(self, observations):
        zero = np.zeros((len(observations), 3))
        return Correction(zero + [0.0, 0.0, 1.0], zero, np.ones(len(zero)))


def test_an_agent_without_reset_may_correct_beliefs():
    result = compare({"mine": Upward()}, ("imm",), episodes=2, beliefs="per-mode")
    mine = result.policies["mine"]["ate_m"].mean
    base = result.policies["imm"]["ate_m"].mean
    assert mine > base + 0.1


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ([0, 0, 0, math.nan, 0, 0, 1], "nan"),
        ([0, 4.1, 0, 0, 0, 0, 1], "4.1"),
        ([0, 0, 0, 0, 0, 0, math.nan], "nan"),
        ([0, 0, 0, 0, 0, 1], r"shape \(2, 6\)"),
        (None, "no attribute 'shift'"),
    ],
)
def test_invalid_corrections_and_banks_are_refused(row, problem, monkeypatch):
    def correct(self, observations):
        made = np.tile(row or [0], (len(observations), 1))
        return row and Correction(made[:, :3], made[:, 3:-1], made[:, -1])

    monkeypatch.setattr(Upward, "correct", correct)
    with pytest.raises(ValueError, match=f"^policy mine: .*{problem}.*epoch 1"):
        compare({"mine": Upward()}, (), episodes=2)
    monkeypatch.setattr(Upward, "bank", 1, raising=False)
    with pytest.raises(ValueError, match="^policy mine: .*bank"):
        compare({"mine": Upward()}, (), episodes=2)


class Weighing:
    """An agent that returns weights of the modes."""

    beliefs = "per-mode"
    modes = TWO
    action = "weights"

    def __call__(self, observations):
        return np.sin(7.0 * observations[:, :2])


def test_an_agent_that_returns_weights_earns_what_it_earns_in_the_environment(monkeypatch):
    options = {"beliefs": "per-mode", "modes": TWO, "action": "weights", "episode_steps": 50}
    env = gym.make("MmWaveLoc-v0", **options)
    observation, _ = env.reset(seed=3)
    earned = []
    for _ in range(50):
        observation, reward, *_ = env.step(Weighing()(observation[None])[0])
        earned.append(reward)
    contender = Contender.own("mine", Weighing(), "handset")
    episodes = draw_episodes(task_from(episode_steps=50).source, [3])
    (rewards,) = run_contender(contender, episodes)["reward"]
    np.testing.assert_allclose(rewards, earned, rtol=1e-9)
    monkeypatch.setattr(Weighing, "modes", [*TWO, "ckf"])
    with refuses("mine"):
        Contender.own("mine", Weighing(), "handset").start(episodes[0].layout)
    monkeypatch.setattr(Weighing, "beliefs", "shared")
    with refuses("mine"):
        compare({"mine": Weighing()}, episodes=1)


@pytest.mark.parametrize(("kind", "name"), [(Corrector, "corrector"), (LearnedSwitch, "guided")])
def test_an_object_of_a_learned_policy_earns_what_its_file_earns(kind, name):
    episodes = draw_episodes(task_from(episode_steps=20).source, [3])
    contenders = Contender.own("mine", kind(name), "handset"), contender_from(name, "handset")
    mine, shipped = (run_contender(each, episodes)["reward"] for each in contenders)
    np.testing.assert_array_equal(mine, shipped)


MISTAKES = {  # name of an agent -> expected message
    "no_such_module:make": "no_such_module:make: ModuleNotFoundError: .*expected module:function",
    "my_agents:gone": "AttributeError: .*'gone'; expected module:function",
    "my_agents:act": "TypeError: .* missing 1 required .*; expected .* no arguments",
    "my_agents:nothing": "found None, expected a function from observations",
    "my_agents:wrong": r"my_agents:wrong: found shape \(3,\) of float64, expected \(3,\) of integ",
    "my_agents:beyond": "my_agents:beyond: found 2 ",
    "my_agents:stumbling": r"RuntimeError: no idea; it was given observations \(3, \d+\), float32",
    "my_agents.py": "policy: found 'my_agents.py', .*module:function",
    "mine.zip": "mine.zip: found a model .*, expected .*; policies.save_sb3",
}


@pytest.mark.parametrize("name", MISTAKES)
def test_an_invalid_agent_is_refused_before_an_episode_runs(name, folder, monkeypatch):
    (folder / "mine.zip").write_bytes(b"")
    monkeypatch.setattr("experiments.evaluation.runner.draw_episodes", None)
    assert_refused(
        f"^mmwave-loc compare: .*{MISTAKES[name]}", "compare", "--policies", name, cwd=folder
    )


@pytest.mark.usefixtures("folder")
def test_attributes_of_an_agent_determine_its_modes_observation_and_beliefs():
    contender = contender_from("my_agents:seeing_priors", "handset")
    assert len(contender.modes) == 3 and contender.observation == "prior"
    plain = contender_from("my_agents:second", "handset", observation="prior")
    assert len(plain.modes) == 2 and plain.observation == "prior"
    per_mode = contender_from("my_agents:per_mode", "handset")
    assert per_mode.bank == Bank(modes_from(["ekf", "ckf"])) and per_mode.beliefs == "per-mode"
    named = contender_from("my_agents:second", "handset", HANDSET, beliefs="per-mode")
    assert named.bank == HANDSET and named.actions == ["none", "stand", "walk", "ride"]
    with refuses("beliefs"):
        contender_from("my_agents:second", "handset", beliefs="mine")
    with refuses("observation"):
        contender_from("my_agents:second", "handset", observation="half").start(Layout())


@pytest.mark.usefixtures("folder")
def test_compare_accepts_objects_modules_files_and_loaded_policies(tmp_path):
    file = write(tmp_path / "policy.safetensors", actor(), card_of())

    class Recording:
        """An agent that records its observations and which episodes begin."""

        def __init__(self):
            self.begins = []
            self.observed = []

        def reset(self, begins):
            self.begins.append(begins)

        def __call__(self, observations):
            self.observed.append(observations)
            return np.ones(len(observations), np.uint8)

    mine = Recording()
    agents = {"object": mine, "module": "my_agents:second"}
    agents |= {"file": file, "loaded": LearnedSwitch(file)}
    agents |= {"named": "fixed-ukf", "function": lambda o: np.ones(len(o), int)}
    comparison = compare(agents, beside=("fixed-ukf",), episodes=3, seed=4)
    assert (comparison.scenario, *comparison.seeds) == ("mixed", 4, 5, 6)
    rows = comparison.policies
    assert list(rows) == [*agents, "fixed-ukf"]
    for name in ("object", "module", "named", "function"):
        assert rows[name] == rows["fixed-ukf"]
    assert rows["file"] == rows["loaded"] != rows["fixed-ukf"]
    assert all(begins.all() for begins in mine.begins) and len(mine.begins[-1]) == 3
    first = mine.observed[0]
    assert all(o.shape == first.shape and o.dtype == np.float32 for o in mine.observed)
    assert len(mine.observed) == 201 and len(first) == 3  # one call as a check, then 200 steps


@pytest.mark.slow
def test_the_command_line_supports_beliefs_per_mode(folder):
    write_json(folder / "bank.json", bank_as_written(HANDSET))
    words = ("--beliefs", "per-mode", "--modes", "bank.json", "--episodes", 2)
    shown = succeed("compare", "--policies", "my_agents:second", "imm", *words, cwd=folder)
    assert "| my_agents:second | -" in shown and "minus imm" in shown
    rows = compare({"mine": "my_agents:second"}, (), beliefs="per-mode", modes=HANDSET, episodes=2)
    mine = str(rows).split("| mine |")[1].partition("\n")[0]
    assert f"| my_agents:second |{mine}" in shown


@pytest.mark.parametrize(
    "act",
    [lambda o: np.ones((len(o), 1), int), lambda o: (np.ones(len(o), int), None), np.ones(3)],
)
def test_invalid_actions_are_refused(act):
    with pytest.raises(ValueError, match="mine.*model.predict"):
        compare({"mine": act}, beside=(), episodes=2)


MINE = {"mine": np.zeros_like}


@pytest.mark.parametrize(
    ("refused", "agents", "options"),
    [
        ("policy", {}, {"beside": ("oracle",)}),
        ("policies", {"imm": np.zeros_like}, {"beside": ("imm",)}),
        ("beside", {}, {"beside": "imm"}),
        ("beside", {}, {"beside": (1,)}),
        ("policies", {}, {"beside": ()}),
        ("policies", {1: np.zeros_like}, {}),
        ("seed", MINE, {"seed": "1"}),
        ("policies", len, {}),
        ("scenario", {}, {"scenario": "train"}),
        ("modes", MINE, {"modes": HANDSET}),
        ("episodes", {}, {"episodes": "ride"}),
        ("reward", MINE, {"reward": "paired"}),
        ("action", MINE, {"action": "weights"}),
        ("policy", {"mine": lambda o, few=[0] * 9: np.full(len(o), few.pop())}, {}),
    ],
)
def test_wrong_arguments_of_compare_are_refused(refused, agents, options):
    with refuses(refused):
        compare(agents, **options)


def test_an_unknown_option_of_compare_is_refused_and_all_known_options_are_named():
    with pytest.raises(TypeError, match="'odometer', expected one of .*odometry"):
        compare({}, odometer=True)
