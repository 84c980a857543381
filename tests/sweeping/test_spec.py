"""A sweep is read: every combination once, and what is wrong is named."""

import pytest

from experiments.sweeping.cells import keep, kept, read
from experiments.sweeping.spec import read_spec

GRID = """
[evaluate]
policy = ["fixed-ekf", "imm"]
radio = ["handset", "standard"]
modes = ["ekf", "ukf"]
dt = [1, 0.5]
seed = [0, 10]
"""
SEARCH = """
[search]
trials = 6
total_timesteps = 1000
hyperparameters.learning_rate = { low = 1e-4, high = 1, log = true }
hyperparameters.n_epochs = { low = 4, high = 16 }
hyperparameters.hidden = [[64, 64], [32]]
"""


def spec_of(tmp_path, text, name="grid.toml"):
    (tmp_path / name).write_text(text)
    return read_spec(tmp_path / name)


def test_every_combination_is_a_cell(tmp_path):
    spec = spec_of(tmp_path, GRID)
    assert len(spec) == len(spec.cells) == 2 * 2 * 2 * 2
    first, *_, last = spec.cells.values()
    assert first == {
        "policy": "fixed-ekf", "radio": "handset", "modes": ("ekf", "ukf"), "dt": 1.0, "seed": 0,
    }  # fmt: skip
    assert last["dt"] == 0.5 and isinstance(first["dt"], float)


def test_a_list_of_lists_is_an_axis_of_lists(tmp_path):
    spec = spec_of(tmp_path, '[evaluate]\npolicy = "imm"\nmodes = [["ekf", "ukf"], ["ckf"]]\n')
    assert [cell["modes"] for cell in spec.cells.values()] == [("ekf", "ukf"), ("ckf",)]


def test_names_are_those_of_the_work_whatever_the_order(tmp_path):
    one = spec_of(tmp_path, '[evaluate]\npolicy = ["imm", "fixed-ekf"]\nseed = [10, 0]\n')
    text = '{"evaluate": {"seed": [0, 10], "policy": ["fixed-ekf", "imm"]}}'
    other = spec_of(tmp_path, text, "grid.json")
    assert one.cells.keys() == other.cells.keys()


def test_other_content_of_a_file_that_is_named_is_another_cell(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, names = '[evaluate]\npolicy = "imm"\nmodes = ["ekf", "own.json"]\n', set()
    for content in ("", "1", "2"):
        (tmp_path / "own.json").write_text(content)
        names |= spec_of(tmp_path, text).cells.keys()
    assert len(names) == 3


def test_a_search_has_distributions(tmp_path):
    pytest.importorskip("optuna")
    spec = spec_of(tmp_path, SEARCH)
    rate, epochs, hidden = spec.free.values()
    assert (rate.low, rate.high, rate.log) == (1e-4, 1.0, True)
    assert epochs.to_external_repr(epochs.high) == 16 and isinstance(epochs.low, int)
    assert hidden.choices == ("[64, 64]", "[32]") and len(spec) == 6
    proposal = dict(zip(spec.free, (1e-3, 5, "[32]"), strict=True))
    assert spec.values_of(proposal) == {
        "total_timesteps": 1000, "hyperparameters.learning_rate": 1e-3,
        "hyperparameters.n_epochs": 5, "hyperparameters.hidden": (32,),
    }  # fmt: skip
    more = spec_of(tmp_path, SEARCH.replace("trials = 6", "trials = 7"))
    other = spec_of(tmp_path, SEARCH.replace("16", "17"))
    assert more.trial == spec.trial != other.trial


@pytest.mark.parametrize(("text", "cells"), [
    ("seed = [{}]".format(", ".join(map(str, range(100_001)))), 100_001),
    ("\n".join(f"{key} = {list(range(1, 1001))}" for key in ("seed", "episodes")), 1_000_000),
])  # fmt: skip
def test_too_many_cells_are_refused_before_they_are_made(tmp_path, text, cells):
    with pytest.raises(ValueError, match=f"found {cells} cells, expected at most 100000"):
        spec_of(tmp_path, f'[evaluate]\npolicy = "imm"\n{text}\n')


def test_rows_are_kept_apart_and_those_of_others_refused(tmp_path):
    pytest.importorskip("pyarrow")
    spec = spec_of(tmp_path, '[evaluate]\npolicy = ["imm", "ppo"]\nreward = "tracking"\n')
    folder, (name, _) = tmp_path / "out", spec.cells
    keep(folder, name, spec.cells[name], {"reward_mean": -1.5, "reward_each": [-1.0, -2.0]})
    (folder / ".half.parquet").write_bytes(b"PAR1 and no more")
    assert kept(folder, spec) == {name}
    row = {"reward": "tracking", "reward_mean": -1.5, "reward_each": [-1.0, -2.0]}
    assert read(folder, spec) == {name: {"policy": "imm"} | row}
    other = spec_of(tmp_path, '[evaluate]\npolicy = "imm"\nseed = 1\n')
    with pytest.raises(ValueError, match=f"{name}.parquet: found a row of another sweep"):
        kept(folder, other)
    (folder / f"{name}.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(ValueError, match=f"{name}.parquet: found no row .*; remove it"):
        read(folder, spec)


POLICY = '[evaluate]\npolicy = "imm"\n'
TRAIN = "[train]\ntotal_timesteps = 5\n"
RATE = "[search]\ntrials = 3\ntotal_timesteps = 5\nhyperparameters."


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found {}, expected one table of evaluate, train, search"),
        ("[evalute]\n", "table: found 'evalute', did you mean evaluate"),
        ("[evaluate]\nseed = 0\n", "evaluate.policy: found none, expected one"),
        (POLICY + 'raido = "handset"\n', "evaluate: key: found 'raido', did you mean radio"),
        (POLICY + "radio = 3\n", "evaluate.radio: found 3, expected str"),
        (POLICY + "episodes = 0\n", "evaluate.episodes: found 0, expected an integer of 1 to"),
        (POLICY + "dt = [-inf]\n", "evaluate.dt: found -inf, expected a number"),
        ("[evaluate]\npolicy = []\n", "policy: found \\[\\], expected values, each once"),
        ('[evaluate]\npolicy = ["imm", "imm"]\n', "expected values, each once"),
        (TRAIN + 'algo = "dqn"\n', "train.algo: found 'dqn', expected one of ppo"),
        (TRAIN + "hyperparameters.rate = 1\n", "hyperparameters: found 'rate', expected one of"),
        (TRAIN + "hyperparameters.gamma = [0.9, 2]\n", "gamma: found 2.0, expected a number in"),
        (TRAIN + "hyperparameters.gamma = { low = 0.8, high = 0.9 }\n", "gamma: found {'low'"),
        ("[search]\ntrials = 0\ntotal_timesteps = 5\n", "search.trials: found 0, expected"),
        ("[search]\ntrials = 3\ntotal_timesteps = 5\n", "search: expected hyperparameters to try"),
        (RATE + 'gamma = [0.8]\nradio = ["handset", "high"]\n', "one value of all else"),
        (RATE + "gamma = { low = 0.9, high = 0.8 }\n", "gamma: found .*, expected low, high"),
        (RATE + f"gamma = {{ low = 0, high = 1{'0' * 400} }}\n", "gamma: found 10*"),
        (RATE + "n_epochs = { low = 1.5, high = 3 }\n", "n_epochs: found 1.5, expected an integer"),
        ("[evaluate\n", "not a sweep: Expected"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, text, message):
    if "search" in text:
        pytest.importorskip("optuna")
    with pytest.raises(ValueError, match=message):
        spec_of(tmp_path, text)
