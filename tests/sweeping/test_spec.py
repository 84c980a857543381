"""Tests of reading sweep files and of keeping the results of cells.

A *cell* is a combination of values: one value of each key of the file.
"""

import numpy as np
import pytest

from experiments.sweeping.run import keep, kept, read, read_spec
from tests.refusals import refuses

GRID = """
[evaluate]
policy = ["fixed-ekf", "imm"]
radio = ["handset", "standard"]
modes = ["ekf", "ukf"]
dt = [1, 0.5]
seed = [0, 10]
"""
POLICY = '[evaluate]\npolicy = "imm"\n'


def spec_of(tmp_path, text):
    path = tmp_path / "grid.toml"
    path.write_text(text)
    return read_spec(path)


def test_every_combination_of_values_is_a_cell(tmp_path):
    spec = spec_of(tmp_path, GRID)
    assert len(spec.cells) == 2 * 2 * 2 * 2
    first, *_, last = spec.cells.values()
    values = ("fixed-ekf", "handset", ("ekf", "ukf"), 1, 0)
    assert first == dict(zip(spec.axes, values, strict=True))
    assert last["dt"] == 0.5 and isinstance(first["dt"], float)
    spec = spec_of(tmp_path, POLICY + 'modes = [["ekf", "ukf"], ["ckf"]]\n')
    assert [cell["modes"] for cell in spec.cells.values()] == [("ekf", "ukf"), ("ckf",)]


def test_names_of_cells_do_not_depend_on_order(tmp_path):
    spec = spec_of(tmp_path, '[evaluate]\npolicy = ["imm", "fixed-ekf"]\nseed = [10, 0]\n')
    text = '[evaluate]\nseed = [0, 10]\npolicy = ["fixed-ekf", "imm"]\n'
    assert spec.cells.keys() == spec_of(tmp_path, text).cells.keys()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("own.json", POLICY + 'modes = ["ekf", "own.json"]\n'),
        ("mine.py", '[evaluate]\npolicy = "mine:agent"\n'),
        ("run/policy.safetensors", '[evaluate]\npolicy = "run"\n'),
        ("own.json", '[train]\ntotal_timesteps = 1\nplaces = [["own.json:handset"]]\n'),
    ],
)
def test_cells_have_new_names_if_a_file_changes(tmp_path, monkeypatch, file, text):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "run").mkdir()
    names = set()
    for content in ("", "1", "2"):
        (tmp_path / file).write_text(content)
        names |= spec_of(tmp_path, text).cells.keys()
    assert len(names) == 3


def test_a_list_of_measurements_is_one_value(tmp_path):
    spec = spec_of(tmp_path, POLICY + 'measurements = ["range", "azimuth"]\n')
    assert [cell["measurements"] for cell in spec.cells.values()] == [("range", "azimuth")]


def test_too_many_cells_are_refused_before_they_are_made(tmp_path):
    lines = (f"{key} = {list(range(1, 1001))}" for key in ("seed", "episodes"))
    with refuses("evaluate"):
        spec_of(tmp_path, POLICY + "\n".join(lines))


def test_results_are_kept_per_cell_and_results_of_other_sweeps_are_refused(tmp_path):
    pytest.importorskip("pyarrow")
    spec = spec_of(tmp_path, '[evaluate]\npolicy = ["imm", "ppo"]\nreward = "tracking"\n')
    folder = tmp_path / "out"
    name, _ = spec.cells
    keep(folder, name, spec.cells[name], {"reward_mean": -1.5, "reward_each": [-1.0, -2.0]})
    (folder / ".half.parquet").write_bytes(b"PAR1 and no more")
    assert kept(folder, spec) == {name}
    row = {"reward": "tracking", "reward_mean": -1.5, "reward_each": [-1.0, -2.0]}
    assert read(folder, spec) == {name: {"policy": "imm"} | row}
    other = spec_of(tmp_path, POLICY + "seed = 1\n")
    with refuses(f"{name}.parquet"):
        kept(folder, other)
    stored = folder / f"{name}.parquet"
    content = stored.read_bytes()
    for damaged in (b"PAR1 and no more", content.replace(np.float64(-1.5).tobytes(), bytes(8))):
        assert damaged != content
        stored.write_bytes(damaged)
        with refuses(f"{name}.parquet"):
            read(folder, spec)


TRAIN = "[train]\ntotal_timesteps = 5\n"


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("", "not a sweep"),
        ("[evaluate\n", "grid.toml"),
        ("[evalute]\n", "table"),
        ("[evaluate]\nseed = 0\n", "evaluate.policy"),
        (POLICY + 'raido = "handset"\n', "evaluate.key"),
        (POLICY + "episodes = 0\n", "evaluate.episodes"),
        (POLICY + "dt = [-inf]\n", "evaluate.dt"),
        ('[evaluate]\npolicy = ["imm", "imm"]\n', "policy"),
        (TRAIN + 'algo = "dqn"\n', "train.algo"),
        (TRAIN + "hyperparameters.rate = 1\n", "hyperparameters"),
        (TRAIN + "hyperparameters.gamma = { low = 0.8, high = 0.9 }\n", "gamma"),
    ],
)
def test_the_error_about_a_wrong_sweep_names_the_field(tmp_path, text, field):
    with refuses(field):
        spec_of(tmp_path, text)
