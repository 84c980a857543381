"""A search is read, and what Ray Tune proposes lies within it."""

import numpy as np
import pytest

from experiments.sweeping.search import Range
from experiments.sweeping.spec import read_spec
from experiments.sweeping.tuner import proposed, trials

SEARCH = """
[search]
trials = 6
total_timesteps = 1000
radio = "handset"
hyperparameters.learning_rate = { low = 1e-4, high = 1e-2, log = true }
hyperparameters.n_epochs = { low = 4, high = 16 }
hyperparameters.hidden = [[64, 64], [32]]
"""


def spec_of(tmp_path, text):
    (tmp_path / "search.toml").write_text(text)
    return read_spec(tmp_path / "search.toml")


def valley(cell):
    """A result whose reward is greatest where the learning rate is 1e-3; fails in one half."""
    values = dict(cell.values)
    if values["hyperparameters.hidden"] == (32,):
        raise ValueError("too narrow")
    distance = abs(values["hyperparameters.learning_rate"] - 1e-3)
    scores = {metric: [-distance, -distance] for metric in ("reward", "ate_m")}
    return {
        "scores": scores, "episode_seed": [0, 1], "episode_key": [2**63 + 1, None],
        "warnings": [], "policy": b"left out",
    }  # fmt: skip


def test_what_is_free_is_read(tmp_path):
    spec = spec_of(tmp_path, SEARCH)
    assert len(spec) == 6 and spec.cells == ()
    free = dict(spec.search.free)
    assert free["hyperparameters.learning_rate"] == Range(1e-4, 1e-2, log=True)
    assert free["hyperparameters.n_epochs"] == Range(4, 16)
    assert free["hyperparameters.hidden"] == ((64, 64), (32,))
    cell = spec.search.cell({"hyperparameters.n_epochs": 5})
    assert dict(cell.values) == {
        "hyperparameters.n_epochs": 5, "radio": "handset", "total_timesteps": 1000,
    }  # fmt: skip


def test_another_range_is_another_run(tmp_path):
    other = spec_of(tmp_path, SEARCH.replace("1e-4", "2e-4")).run
    assert spec_of(tmp_path, SEARCH).run != other


def test_trials_lie_in_their_range_and_apart(tmp_path):
    near = "{ low = 0.999, high = 0.9999 }"
    search = spec_of(tmp_path, f"{RATE}gamma = {near}\n").search
    drawn = np.random.default_rng(0).uniform(0.999, 0.9999, 50)
    cells = {proposed(search, {"hyperparameters.gamma": float(gamma)}) for gamma in drawn}
    found = [dict(cell.values)["hyperparameters.gamma"] for cell in cells]
    assert len(found) == 50 and min(found) >= 0.999 and max(found) <= 0.9999


RATE = "[search]\ntrials = 3\ntotal_timesteps = 5\nhyperparameters."


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("search = 3\n", "search: found 3, expected a table"),
        (SEARCH + "[train]\ntotal_timesteps = 5\n", "search: found 'train' beside it, expected it"),
        (
            SEARCH.replace("trials = 6", "trials = 0"),
            "search.trials: found 0, expected a whole number",
        ),
        ("[search]\ntrials = 3\ntotal_timesteps = 5\n", "search.hyperparameters: found none, exp"),
        (SEARCH.replace("radio", "raido"), "search: key: found 'raido', did you mean radio"),
        (SEARCH.replace("total_timesteps = 1000", ""), "search.total_timesteps: found none"),
        (SEARCH.replace('"handset"', '["handset", "standard"]'), "search.radio: found 2 values"),
        (RATE + "rate = 1\n", "hyperparameters: found 'rate', expected one of num_envs"),
        (RATE + "gamma = { low = 0.9 }\n", "gamma: found .*, expected low and high, numbers"),
        (RATE + "gamma = { low = 0.9, high = 0.8 }\n", "expected low below high"),
        (
            RATE + "gamma = { low = 0, high = 0.8, log = true }\n",
            "expected log true or false, and",
        ),
        (RATE + "gamma = { low = 0, high = inf }\n", r"expected low below high, from 0 to 1e\+15"),
        (RATE + f"gamma = {{ low = 0, high = 1{'0' * 400} }}\n", "expected low below high"),
        (RATE + "gamma = { from = 0.9, high = 1 }\n", "gamma: key: found 'from', expected one of"),
        (RATE + "n_epochs = { low = 1.5, high = 3 }\n", "expected low and high, whole numbers"),
        (SEARCH.replace("trials", "trails"), "found 'trails', did you mean trials"),
        (RATE + "gamma = 0.9\n", "hyperparameters: found one combination, expected a range or"),
        (RATE + "gamma = []\n", "gamma: found an empty list, expected values"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        spec_of(tmp_path, text)


@pytest.mark.slow
def test_trials_are_proposed_kept_and_not_computed_again(tmp_path):
    pytest.importorskip("ray.tune")
    pytest.importorskip("optuna")
    search = spec_of(tmp_path, SEARCH).search
    done = trials(valley, search, tmp_path, 2, 1)
    assert len(done) == 6 == len({one.cell for one in done})
    for one in done:
        values = dict(one.cell.values)
        assert 1e-4 <= values["hyperparameters.learning_rate"] <= 1e-2
        assert values["hyperparameters.n_epochs"] in range(4, 17)
        if values["hyperparameters.hidden"] == (32,):
            assert one.result is None and "too narrow" in one.error
        else:
            expected = valley(one.cell)
            assert "policy" not in one.result
            for key in ("scores", "episode_seed", "episode_key", "warnings"):
                assert one.result[key] == expected[key]

    def never(cell):
        assert dict(cell.values)["hyperparameters.hidden"] == (32,)  # what failed is tried again
        return valley(cell)

    again = trials(never, search, tmp_path, 2, 1)
    assert {(one.cell, one.error) for one in again} == {(one.cell, one.error) for one in done}
