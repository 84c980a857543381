"""mmwave-loc collect: a data set that Minari loads, and that the environment gives again."""

import json
import shlex

import numpy as np
import pytest

from experiments.offline import transitions
from mmwave_env.filters.bank import best_bank
from mmwave_env.filters.mode_files import default_modes
from policies import SpeedRule
from tests.cli import assert_one_clear_line, command, succeed

minari = pytest.importorskip("minari")

pytestmark = pytest.mark.slow
POLICIES = ("ppo", "speed-rule", "random")
SHORT = ("--episodes", 3, "--episode-steps", 12)
FIRST = 10_000_000


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder with a data set of the two modes, and one of beliefs per mode."""
    folder = tmp_path_factory.mktemp("datasets")
    succeed("collect", "--policies", *POLICIES, *SHORT, "--out", folder)
    shown = succeed("collect", *SHORT, "--id", "per-mode-v1", "--out", folder)  # the usual three
    assert "| guided | -" in shown and "minari.load_dataset('per-mode-v1')" in shown
    return folder


@pytest.fixture
def load(root, monkeypatch):
    """How Minari loads them."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(root))
    return minari.load_dataset


def about(dataset):
    """Metadata of the episodes."""
    return list(dataset.storage.get_episode_metadata(dataset.episode_indices))


def assert_alike(one, two):
    """Two data sets hold the same episodes."""
    for a, b in zip(one, two, strict=True):
        for part in ("observations", "actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(a, part), getattr(b, part))
        for key, values in a.infos.items():
            np.testing.assert_array_equal(values, b.infos[key])


# --- what is in it


def test_minari_lists_the_sets_and_says_what_they_are(load):
    listed = minari.list_local_datasets()
    assert list(listed) == ["per-mode-v1", "mmwave-loc/collected-v0"]
    known = listed["mmwave-loc/collected-v0"]
    assert known["algorithm_name"] == "ppo, speed-rule, random"
    assert known["actions"] == ["ekf", "ukf"] and known["author"] == ["mmwave-loc"]
    assert (known["total_episodes"], known["total_steps"]) == (9, 9 * 12)
    told = about(load("mmwave-loc/collected-v0"))
    seeds = [FIRST, FIRST + 1, FIRST + 2]
    assert [(one["policy"], one["seed"]) for one in told] == [
        (name, seed) for name in POLICIES for seed in seeds
    ]
    assert len({one["key"] for one in told}) == 3


@pytest.mark.parametrize("name", ["mmwave-loc/collected-v0", "per-mode-v1"])
def test_the_environment_that_minari_recovers_gives_every_transition_again(load, name):
    dataset = load(name)
    env = dataset.recover_environment(infos="fixed")
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    assert dataset.env_spec.id == "MmWaveLoc-v0" and dataset.env_spec.max_episode_steps == 12
    for episode, told in zip(dataset, about(dataset), strict=True):
        seen, info = env.reset(seed=told["seed"])
        np.testing.assert_array_equal(seen, episode.observations[0])
        infos = [info]
        for t, action in enumerate(episode.actions):
            seen, reward, terminated, truncated, info = env.step(action)
            np.testing.assert_array_equal(seen, episode.observations[t + 1])
            found = (episode.rewards[t], episode.terminations[t], episode.truncations[t])
            assert found == (reward, terminated, truncated)
            infos.append(info)
        assert truncated and set(episode.infos) == set(transitions.TOLD)
        for key, values in episode.infos.items():
            np.testing.assert_array_equal(values, [info[key] for info in infos])
        again, _ = env.reset(options={"episode_key": told["key"]})
        np.testing.assert_array_equal(again, episode.observations[0])


def test_actions_are_what_the_policies_choose(load):
    dataset = load("mmwave-loc/collected-v0")
    rule = SpeedRule(dataset.recover_environment().unwrapped.observation)
    by_rule = [e for e, told in zip(dataset, about(dataset), strict=True)
               if told["policy"] == "speed-rule"]  # fmt: skip
    assert len(by_rule) == 3
    for episode in by_rule:
        np.testing.assert_array_equal(episode.actions, rule(episode.observations[:-1]))
    per_mode = load("per-mode-v1")
    trusting = {
        told["policy"]: e.actions for e, told in zip(per_mode, about(per_mode), strict=True)
    }
    assert not trusting["imm"].any() and set(trusting["random"]) <= set(range(6))


def test_an_environment_brings_the_numbers_of_its_modes(load, tmp_path):
    recovered = load("mmwave-loc/collected-v0").recover_environment().unwrapped
    assert recovered.modes == default_modes("handset")
    assert load("per-mode-v1").recover_environment().unwrapped.modes == best_bank("handset").modes
    file = tmp_path / "mine.json"
    file.write_text(json.dumps({"modes": [{"name": "a", "sigma_v": 0.1 + 0.2}, {"name": "b"}]}))
    options = ("--modes", file, "--policies", "fixed-b", "random", "--observation", "prior")
    succeed("collect", *options, *SHORT, "--out", tmp_path, "--id", "mine-v0", "--planar")
    file.unlink()
    mine = minari.MinariDataset(tmp_path / "mine-v0" / "data").recover_environment().unwrapped
    assert mine.modes[0].name == "a" and mine.modes[0].sigma_v == 0.1 + 0.2
    assert mine.observation.kind == "prior"


def test_returns_are_normalized_by_chance_and_the_best(load):
    dataset = load("mmwave-loc/collected-v0")
    returns = {name: [] for name in POLICIES}
    for episode, told in zip(dataset, about(dataset), strict=True):
        returns[told["policy"]].append(episode.rewards.sum())
    means = {name: np.mean(values) for name, values in returns.items()}
    scores = minari.get_normalized_score(dataset, np.array([means["random"], max(means.values())]))
    np.testing.assert_allclose(scores, [0.0, 1.0], atol=1e-12)


def test_the_command_in_the_metadata_makes_the_set_again(root, tmp_path):
    name = "mmwave-loc/collected-v0"
    first = minari.MinariDataset(root / name / "data")
    _, *words = shlex.split(first.storage.metadata["command"])
    succeed(*words, "--out", tmp_path)
    assert_alike(first, minari.MinariDataset(tmp_path / name / "data"))


def test_it_is_the_same_set_in_small_parts(root, tmp_path, monkeypatch):
    monkeypatch.setattr(transitions, "EPOCHS_AT_ONCE", 2 * 12)  # of three episodes, 2 and then 1
    succeed("collect", "--policies", "ppo", "speed-rule", *SHORT, "--out", tmp_path)
    whole, parts = (
        minari.MinariDataset(folder / "mmwave-loc/collected-v0/data") for folder in (root, tmp_path)
    )
    assert_alike(whole.iterate_episodes(range(6)), parts)


def test_recordings_have_seeds_but_no_keys_and_are_warned_of(tmp_path):
    words = ("--policies", "random", "--data", "canyon28_vehicle", "--episodes", 2)
    done = command("collect", *words, "--out", tmp_path, "--id", "car-v0")
    assert done.returncode == 0 and "canyon28_vehicle is for tests" in done.stderr
    dataset = minari.MinariDataset(tmp_path / "car-v0" / "data")
    assert [set(told) for told in about(dataset)] == [{"id", "seed", "total_steps", "policy"}] * 2
    seen, _ = dataset.recover_environment().reset(seed=FIRST + 1)
    np.testing.assert_array_equal(seen, dataset[1].observations[0])


# --- mistakes


MISTAKES = {
    "test seeds": (("--seed", 0), "seed: found 0, expected a training seed >= 10000000"),
    "tuning seeds": (("--seed", 5_000_000), "seed: found 5000000.*tuning"),
    "no episodes": (("--episodes", 0), "episodes: found none"),
    "no policies": (("--policies",), "policies: found none"),
    "a policy twice": (("--policies", "random", "random"), "expected each name once"),
    "an unknown policy": (("--policies", "guide"), "'guide'.*did you mean guided"),
    "two environments": (("--policies", "guided", "ppo"), "guided .none, stand.* and ppo .ekf, uk"),
    "a rule of others": (("--policies", "guided", "speed-rule"), "'speed-rule' beside guided.*imm"),
    "no mode of these": (("--policies", "fixed-ckf"), "'fixed-ckf'.*fixed-ekf, fixed-ukf"),
    "an IMM": (("--policies", "imm-best"), "'imm-best', an IMM"),
    "the IMM": (("--policies", "imm"), "'imm'.*fixed-ekf"),
    "no version": (("--id", "mine"), "id: found 'mine'.*collected-v0"),
    "an escape": (("--id", "../mine-v0"), "id: found '../mine-v0'"),
    "a rule that sees nothing": (
        ("--policies", "likelihood-rule", "--observation", "prior"),
        "'likelihood-rule', expected",
    ),
    "another observation": (("--odometry",), "guided.*trained with.*features"),
    "an unknown reward": (("--reward", "speed"), "reward: found 'speed'"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_ends_with_one_clear_line_and_no_files(mistake, tmp_path):
    words, message = MISTAKES[mistake]
    done = command("collect", *words, "--out", tmp_path / "new")
    assert_one_clear_line(done, f"^mmwave-loc collect: .*{message}")
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_replaced_only_where_it_was_collected(tmp_path):
    words = ("collect", "--policies", "fixed-ekf", *SHORT, "--out", tmp_path, "--id", "a-v0")
    succeed(*words)
    assert_one_clear_line(command(*words), "found a data set in .*a-v0.*; --overwrite replaces it")
    succeed(*words, "--overwrite", "--seed", FIRST + 7)
    dataset = minari.MinariDataset(tmp_path / "a-v0" / "data")
    assert [told["seed"] for told in about(dataset)] == [FIRST + 7, FIRST + 8, FIRST + 9]
    metadata = tmp_path / "a-v0" / "data" / "metadata.json"
    for text in ('{"command": "another program"}', "[]", "half of"):
        metadata.write_text(text)
        refused = command(*words, "--overwrite")
        assert_one_clear_line(refused, "found something else in .*a-v0.*there; --id names another")
    assert [path.name for path in tmp_path.iterdir()] == ["a-v0"]


def test_a_policy_that_fails_leaves_what_was_there(tmp_path, monkeypatch):
    (tmp_path / "fails_late.py").write_text(
        "import numpy as np\n"
        "def make():\n"
        "    calls = iter([0] * 8)\n"
        "    return lambda seen: np.full(len(seen), next(calls, 9))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    words = ("collect", *SHORT, "--out", tmp_path / "sets", "--id", "a-v0", "--policies")
    succeed(*words, "fixed-ekf")
    done = command(*words, "fails_late:make", "--overwrite")
    assert_one_clear_line(done, "actions of fails_late:make: found 9 to 9, expected 0 to 1")
    assert [path.name for path in (tmp_path / "sets").iterdir()] == ["a-v0"]
    assert about(minari.MinariDataset(tmp_path / "sets/a-v0/data"))[0]["policy"] == "fixed-ekf"
