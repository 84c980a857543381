"""The table of epochs beside what else a comparison says of them."""

import csv
import json

import gymnasium
import numpy as np
import pytest

from experiments.evaluation.epochs_parquet import columns_of
from mmwave_env.datasets.samples import sample_names
from mmwave_env.metrics import BURN_IN, METRICS
from mmwave_env.models.measurement import Layout
from tests.cli import assert_one_clear_line, command, succeed

parquet = pytest.importorskip("pyarrow.parquet")

POLICIES = ("fixed-ukf", "imm")
STEPS = 20
TWO = ("--policies", *POLICIES, "--episodes", 2, "--episode-steps", STEPS, "--seed", 4)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """The table, the CSV of episodes and the JSON of one comparison."""
    folder = tmp_path_factory.mktemp("epochs")
    files = ("--epochs-parquet", folder / "e.parquet", "--episodes-csv", folder / "e.csv",
             "--json", folder / "r.json", "--percentiles", "--risk", 0.05)  # fmt: skip
    succeed("compare", *TWO, *files)
    assert sorted(path.name for path in folder.iterdir()) == ["e.csv", "e.parquet", "r.json"]
    with (folder / "e.csv").open() as file:
        rows = list(csv.DictReader(file))
    return (
        parquet.read_table(folder / "e.parquet"),
        rows,
        json.loads((folder / "r.json").read_text()),
    )


def columns(table):
    """As numpy arrays by name."""
    return {name: table[name].to_numpy() for name in table.column_names}


def test_there_is_a_row_for_every_policy_episode_and_epoch(found):
    table, rows, _ = found
    one = columns(table)
    which = zip(*(one[name] for name in ("policy", "seed", "key", "epoch")), strict=True)
    expected = [(r["policy"], int(r["seed"]), int(r["key"]), t) for r in rows for t in range(STEPS)]
    assert list(which) == expected
    np.testing.assert_array_equal(one["time_s"], one["epoch"])
    np.testing.assert_array_equal(one["counts"], one["epoch"] >= BURN_IN)


def test_columns_say_what_they_are(found):
    table, _, _ = found
    described = columns_of(Layout(3))
    assert table.column_names == list(described)
    for field in table.schema:
        assert field.metadata[b"description"].decode() == described[field.name][1] != ""
    assert table.schema.metadata[b"risk"] == b"0.05"


def test_means_over_what_counts_are_those_of_the_episodes(found):
    table, rows, _ = found
    one = columns(table)
    for number, row in enumerate(rows):
        epochs = slice(number * STEPS + BURN_IN, (number + 1) * STEPS)
        means = {"reward": one["reward"], "ate_m": one["error_m"], "nees": one["nees"],
                 "rmse_m": one["error_m"] ** 2}  # fmt: skip
        for metric, values in means.items():
            mean = values[epochs].mean() ** (0.5 if metric == "rmse_m" else 1.0)
            assert mean == pytest.approx(float(row[metric])), metric
    assert set(means) < set(METRICS)


def test_positions_errors_and_levels_are_one_another_s(found):
    table, _, result = found
    one = columns(table)
    error = np.stack([one[f"{axis}_m"] - one[f"true_{axis}_m"] for axis in "xyz"])
    np.testing.assert_allclose(np.linalg.norm(error, axis=0), one["error_m"], rtol=1e-9)
    np.testing.assert_allclose(np.hypot(*error[:2]), one["horizontal_error_m"], rtol=1e-9)
    np.testing.assert_allclose(abs(error[2]), one["vertical_error_m"], atol=1e-9)
    for policy, kinds in result["position_errors"]["policies"].items():
        rows = (one["policy"] == policy) & one["counts"]
        for kind, figures in kinds.items():
            size, level = one[f"{kind}_error_m"][rows], one[f"{kind}_level_m"][rows]
            assert figures["epochs"] == len(size) == 2 * (STEPS - BURN_IN)
            assert figures["percentiles_m"]["90"] == np.quantile(size, 0.9)
            assert figures["median_level_m"] == np.median(level)
            assert figures["exceeded"] == (size > level).sum()


def test_it_tells_what_the_environment_s_infos_tell(found):
    table, _, _ = found
    one = columns(table.slice(STEPS, STEPS))
    env = gymnasium.make("MmWaveLoc-v0", episode_steps=STEPS)
    env.reset(seed=5)
    for epoch in range(STEPS):
        *_, info = env.step(1)
        assert one["error_m"][epoch] == pytest.approx(info["position_error_m"])
        assert one["mode"][epoch] == "ukf"
        for group, name in enumerate(("anchor_1", "anchor_2", "anchor_3", "doppler")):
            if info["accepted"][group] or info["rejected"][group]:
                assert one[f"{name}_nis"][epoch] == pytest.approx(info["nis"][group])
                assert one[f"{name}_accepted"][epoch] == info["accepted"][group]
            else:
                assert one[f"{name}_accepted"][epoch] is None
                assert np.isnan(one[f"{name}_nis"][epoch])


def test_large_evaluations_come_a_chunk_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.evaluation.runner.CHUNK", 2)
    more = ("--episodes", 5, "--episode-steps", 12, "--epochs-parquet", tmp_path / "e.parquet")
    succeed("compare", "--policies", *POLICIES, *more)
    file = parquet.ParquetFile(tmp_path / "e.parquet")
    sizes = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    assert sizes == [24, 24, 24, 24, 12, 12]
    seeds = file.read()["seed"].to_numpy().reshape(-1, 12)[:, 0]
    assert seeds.tolist() == [0, 1, 0, 1, 2, 3, 2, 3, 4, 4]


def test_of_recorded_episodes_with_a_known_height_there_is_less_to_tell(tmp_path):
    where = ("--data", sample_names()[0], "--planar", "--episode-steps", 12, "--episodes", 1)
    file = ("--epochs-parquet", tmp_path / "e.parquet")
    succeed("evaluate", "--policy", "imm", *where, *file)
    table = parquet.read_table(tmp_path / "e.parquet")
    for name in ("key", "vertical_error_m", "vertical_level_m"):
        assert table[name].null_count == 12
    assert table["seed"].null_count == 0


def test_what_cannot_be_written_is_refused_before_the_episodes(tmp_path):
    many = ("evaluate", "--episodes", 10**9, "--epochs-parquet")
    ending = "epochs_parquet: found .*, expected a name that ends with .parquet"
    assert_one_clear_line(command(*many, tmp_path / "e.csv"), ending)
    (tmp_path / "e.parquet").mkdir()
    assert_one_clear_line(command(*many, tmp_path / "e.parquet"), "e.parquet: found a folder")


def test_an_evaluation_that_fails_leaves_the_table_before(tmp_path, monkeypatch):
    path = tmp_path / "e.parquet"
    path.write_text("before")

    def fail(*_):
        raise ValueError("reward: found none")

    monkeypatch.setattr("experiments.evaluation.runner._summary", fail)
    more = ("--episodes", 1, "--episode-steps", 12, "--epochs-parquet", path)
    assert_one_clear_line(command("evaluate", "--policy", "fixed-ukf", *more), "reward: found none")
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]
