"""A sweep is read: every combination once, and what is wrong is named."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.sweeping.cell import Cell
from experiments.sweeping.spec import read_spec

GRID = """
[evaluate]
policy = ["fixed-ekf", "fixed-ukf", "imm"]
radio = ["handset", "standard"]
modes = ["ekf", "ukf"]
seed = [0, 10]
episodes = 10
[train]
total_timesteps = 1000
hyperparameters.learning_rate = [1e-3, 3e-4]
"""


def spec_of(tmp_path, text):
    (tmp_path / "grid.toml").write_text(text)
    return read_spec(tmp_path / "grid.toml")


def test_every_combination_is_a_cell(tmp_path):
    spec = spec_of(tmp_path, GRID)
    assert len(spec.cells) == 3 * 2 * 2 + 2 == len({cell.name for cell in spec.cells})
    first = dict(spec.cells[0].values)
    assert first == {"policy": "fixed-ekf", "radio": "handset", "modes": ("ekf", "ukf"), "seed": 0,
                     "episodes": 10}  # fmt: skip
    rates = [dict(cell.values)["hyperparameters.learning_rate"] for cell in spec.cells[-2:]]
    assert rates == [1e-3, 3e-4]


def test_a_list_of_lists_is_an_axis_of_lists(tmp_path):
    spec = spec_of(tmp_path, '[evaluate]\npolicy = "imm"\nmodes = [["ekf", "ukf"], ["ckf"]]\n')
    assert [dict(cell.values)["modes"] for cell in spec.cells] == [("ekf", "ukf"), ("ckf",)]


def test_the_order_of_keys_and_lists_changes_no_name(tmp_path):
    lines = ['policy = ["imm", "fixed-ekf"]', "seed = [10, 0]", "episodes = 5"]
    one = spec_of(tmp_path, "\n".join(["[evaluate]", *lines]))
    turned = ['policy = ["fixed-ekf", "imm"]', "seed = [0, 10]", "episodes = 5"]
    other = spec_of(tmp_path, "\n".join(["[evaluate]", *reversed(turned)]))
    assert {c.name for c in one.cells} == {c.name for c in other.cells} and one.run == other.run


def test_other_content_of_a_file_that_is_named_is_another_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = '[evaluate]\npolicy = "mine"\nmodes = ["ekf", "own.json"]\n'
    runs = [spec_of(tmp_path, text).run]
    (tmp_path / "own.json").write_text("1")
    runs.append(spec_of(tmp_path, text).run)
    (tmp_path / "own.json").write_text("2")
    runs.append(spec_of(tmp_path, text).run)
    (tmp_path / "mine" / "seed-0").mkdir(parents=True)
    (tmp_path / "mine" / "seed-0" / "policy").write_bytes(b"\xff")
    runs.append(spec_of(tmp_path, text).run)
    assert len(set(runs)) == 4 and spec_of(tmp_path, text).run == runs[-1]


@given(st.dictionaries(st.text(), st.integers() | st.text(), max_size=4))
def test_different_values_have_different_names(values):
    cell = Cell("evaluate", tuple(sorted(values.items())))
    other = Cell("evaluate", (*cell.values, ("one more", 1)))
    assert cell.name != other.name and Cell("train", cell.values).name != cell.name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"found nothing, expected a table \[evaluate\] or \[train\]"),
        ("[evalute]\n", "table: found 'evalute', did you mean evaluate[?] Expected one of"),
        ("evaluate = 3\n", "evaluate: found 3, expected a table"),
        ("[evaluate]\nseed = 0\n", "evaluate.policy: found none, expected one"),
        ('[evaluate]\npolicy = "imm"\nraido = "handset"\n', "evaluate: key: found 'raido', .*io"),
        ('[evaluate]\npolicy = "imm"\nradio = 3\n', "evaluate.radio: found 3, expected str"),
        ('[evaluate]\npolicy = "imm"\nepisodes = 0\n', "evaluate.episodes: found 0, expected a wh"),
        ('[evaluate]\npolicy = "imm"\nseed = true\n', "evaluate.seed: found True, expected"),
        ('[evaluate]\npolicy = []\n', "policy: found an empty list, expected values"),
        ('[evaluate]\npolicy = ["imm", "imm"]\n', "found evaluate policy imm twice"),
        ('[evaluate]\npolicy = "imm"\ndt = [-inf]\n', "dt: found -inf, expected words, finite"),
        ('[evaluate]\npolicy = ["imm", 3]\n', "policy: found 3, expected the name of one"),
        ('[evaluate]\npolicy = ""\n', "policy: found '', expected the name of one"),
        ('[evaluate]\npolicy = "imm"\nreward = "rmse"\n', "evaluate.reward: found 'rmse', exp"),
        (f'[evaluate]\npolicy = "imm"\nseed = {2**63 - 1}\n', "expected a whole number below"),
        ("[train]\nalgo = \"ppo\"\n", "train.total_timesteps: found none, expected one"),
        ('[train]\nalgo = "dqn"\ntotal_timesteps = 5\n', "train.algo: found 'dqn', expected one"),
        ("[train]\ntotal_timesteps = 5\nseed = 10000000\n", "train.seed: found 10000000, expected"),
        ("[evaluate\n", "not a sweep: Expected"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        spec_of(tmp_path, text)


@pytest.mark.parametrize(
    "value", ["[1e-3, {}]", "[1e-3, [[]]]", "[{a = 1}]", "[1979-05-27]", "[nan]"]
)
def test_a_value_within_a_value_is_refused(tmp_path, value):
    text = f"[train]\ntotal_timesteps = 1000\nhyperparameters.learning_rate = {value}\n"
    with pytest.raises(ValueError, match="learning_rate: found .*expected words, finite num"):
        spec_of(tmp_path, text)
