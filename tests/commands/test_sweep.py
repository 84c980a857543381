"""mmwave-loc sweep: every cell is kept once, whatever happens on the way."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.sweeping.spec import read_spec
from experiments.training.hyperparameters import read_hyperparameters
from tests.cli import assert_one_clear_line, command, environment, succeed
from tests.paths import ROOT

dataset = pytest.importorskip("pyarrow.dataset")

SMALL = """
[evaluate]
policy = ["fixed-ekf", "imm"]
scenario = ["pedestrian", "vehicle"]
seed = [0, 3]
episodes = 3
episode_steps = 30
"""


def rows(out):
    """All rows of a data set, in an order of their own."""
    found = dataset.dataset(out, format="parquet", partitioning="hive", exclude_invalid_files=True)
    return found.to_table().sort_by([("cell", "ascending"), ("episode_seed", "ascending")])


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "small.toml").write_text(SMALL)
    told = succeed("sweep", folder / "small.toml", "--out", folder / "out", "--workers", "1")
    return folder, told


def test_rows_are_what_compare_tells_of_the_same_episodes(swept, tmp_path):
    folder, _ = swept
    table = rows(folder / "out").to_pylist()
    assert len(table) == 2 * 2 * 2 * 3
    words = ["--policies", "fixed-ekf", "imm", "--scenario", "vehicle", "--episode-steps", "30"]
    succeed("compare", *words, "--episodes", "6", "--episodes-csv", tmp_path / "rows.csv")
    header, *lines = (tmp_path / "rows.csv").read_text().splitlines()
    names = header.split(",")
    expected = {}
    for line in lines:
        row = dict(zip(names, line.split(","), strict=True))
        expected[row["policy"], int(row["seed"])] = (int(row["key"]), float(row["reward"]))
    found = {
        (row["policy"], row["episode_seed"]): (row["episode_key"], row["reward"])
        for row in table
        if row["scenario"] == "vehicle"
    }
    assert found == expected


def test_what_is_there_is_not_computed_again(swept):
    folder, told = swept
    (run,) = (folder / "out").iterdir()
    before = {path: path.stat().st_mtime_ns for path in run.glob("*.parquet")}
    again = command("sweep", folder / "small.toml", "--out", folder / "out")
    assert again.stdout == told and "8 cells, 8 of them kept from before" in again.stderr
    assert {path: path.stat().st_mtime_ns for path in run.glob("*.parquet")} == before


@pytest.mark.slow
def test_a_part_that_is_lost_is_computed_again(swept, tmp_path):
    folder, _ = swept
    expected = rows(folder / "out")
    (run,) = (folder / "out").iterdir()
    first = min(run.glob("*.parquet"))
    first.unlink()
    succeed("sweep", folder / "small.toml", "--out", folder / "out", "--workers", "1")
    assert rows(folder / "out").equals(expected)
    second = min(run.glob("*.parquet"))
    second.write_bytes(second.read_bytes()[:-20])
    done = command("sweep", folder / "small.toml", "--out", folder / "out")
    assert done.returncode == 2 and f"{second}: found no readable Parquet" in done.stderr
    second.unlink()
    succeed("sweep", folder / "small.toml", "--out", folder / "out", "--workers", "1")
    assert rows(folder / "out").equals(expected)


@pytest.mark.slow
def test_a_cell_that_fails_leaves_the_others_whole(tmp_path):
    (tmp_path / "bad.toml").write_text(SMALL.replace('"imm"', '"nobody"'))
    done = command("sweep", tmp_path / "bad.toml", "--out", tmp_path / "out", "--workers", "1")
    assert done.returncode == 2
    assert "4 of 8 cells failed 2 times, the others are there" in done.stderr
    (run,) = (tmp_path / "out").iterdir()
    failed = json.loads((run / "summary.json").read_text())["failed"]
    assert len(failed) == 4 and all("found 'nobody'" in one["error"] for one in failed)
    assert set(rows(tmp_path / "out")["policy"].to_pylist()) == {"fixed-ekf"}


@pytest.mark.slow
def test_a_file_that_was_changed_is_another_sweep(tmp_path):
    (tmp_path / "own.json").write_text('{"base": "handset", "ue_elements": 4}')
    text = '[evaluate]\npolicy = "fixed-ekf"\nradio = "own.json"\nepisodes = 2\n'
    (tmp_path / "own.toml").write_text(text)
    succeed("sweep", "own.toml", cwd=tmp_path)
    again = command("sweep", "own.toml", cwd=tmp_path)
    assert "1 cell, 1 of them kept" in again.stderr
    (tmp_path / "own.json").write_text('{"base": "handset", "ue_elements": 8}')
    changed = command("sweep", "own.toml", cwd=tmp_path)
    assert "1 cell, 0 of them kept" in changed.stderr and changed.stdout != again.stdout


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_a_sweep_by_ray_is_ended_as_any_command(tmp_path):
    pytest.importorskip("ray")
    text = '[evaluate]\npolicy = "fixed-ekf"\nseed = [0, 20000]\nepisodes = 20000\n'
    (tmp_path / "long.toml").write_text(text)
    words = ["sweep", "long.toml", "--engine", "ray"]
    running = subprocess.Popen(
        [sys.executable, "-m", "experiments.console", *words], cwd=tmp_path,
        env=environment(), stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert "2 cells" in running.stderr.readline()
    time.sleep(8.0)  # until Ray has begun
    running.send_signal(signal.SIGTERM)
    _, told = running.communicate(timeout=60)
    assert running.returncode == 143 and told == "mmwave-loc sweep: ended by SIGTERM\n"


def test_what_was_left_half_written_stops_nothing(swept):
    folder, told = swept
    (run,) = (folder / "out").iterdir()
    half = run / ".0123456789abcdef.cells-of-a-killed-sweep.parquet"
    half.write_bytes(b"PAR1 and no more")
    again = command("sweep", folder / "small.toml", "--out", folder / "out")
    half.unlink()
    assert again.stdout == told and "8 of them kept from before" in again.stderr


@pytest.mark.slow
def test_an_option_that_is_called_as_a_metric_has_a_column_of_its_own(tmp_path):
    text = '[evaluate]\npolicy = "imm"\nreward = ["tracking", "log-score"]\nepisodes = 3\n'
    (tmp_path / "rewards.toml").write_text(text)
    told = succeed("sweep", tmp_path / "rewards.toml", "--out", tmp_path / "out")
    assert "policy imm, reward tracking |" in told and "policy imm, reward log-score |" in told
    table = rows(tmp_path / "out").to_pylist()
    assert {row["reward_kind"] for row in table} == {"tracking", "log-score"}
    assert all(isinstance(row["reward"], float) for row in table)


def test_two_at_once_on_one_run_are_refused(swept):
    fcntl = pytest.importorskip("fcntl")
    folder, _ = swept
    (run,) = (folder / "out").iterdir()
    with (run / ".lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        done = command("sweep", folder / "small.toml", "--out", folder / "out")
    assert_one_clear_line(done, "found another sweep at work there, expected none")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["there.toml"], "there.toml: found no such file, expected a sweep, TOML"),
        (["there.toml", "--workers", "0"], "workers: found 0, expected 1 or more"),
        (["there.toml", "--address", "auto"], "address: found one beside engine local, expected"),
    ],
)
def test_mistakes_end_with_one_clear_line(tmp_path, words, message):
    assert_one_clear_line(command("sweep", *words, cwd=tmp_path), message)


@pytest.mark.slow
def test_the_example_of_the_page_runs(tmp_path, monkeypatch, capsys):
    page = (ROOT / "docs" / "sweep.md").read_text("utf-8")
    first, second, third = re.findall(r"^```toml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    (tmp_path / "training.toml").write_text(second)
    assert len(read_spec(tmp_path / "training.toml")) == 6
    (tmp_path / "search.toml").write_text(third)
    assert len(read_spec(tmp_path / "search.toml")) == 20
    shorter = first.replace("[0, 50]", "0").replace("episodes = 50", "episodes = 1")
    (tmp_path / "grid.toml").write_text(shorter)
    succeed("sweep", "grid.toml", "--out", "sweeps", "--workers", "1", cwd=tmp_path)
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    exec(compile(block, "sweep.md", "exec"), {})
    assert capsys.readouterr().out.count("'ate_m_mean'") == 6


@pytest.mark.slow
@pytest.mark.torch
def test_trainings_are_kept_with_their_policies(tmp_path):
    (tmp_path / "train.toml").write_text(
        "[train]\ntotal_timesteps = 1\nepisodes = 12\nseed = [0, 1]\n"
        "hyperparameters.learning_rate = 1e-3\n"
    )
    told = succeed("sweep", tmp_path / "train.toml", "--out", tmp_path / "out")
    (run,) = (tmp_path / "out").iterdir()
    table = rows(tmp_path / "out").to_pylist()
    assert {row["episode_seed"] for row in table} == set(range(5_000_000, 5_000_012))
    policies = {path.stem for path in (run / "policies").iterdir()}
    assert policies == {row["cell"] for row in table} and len(policies) == 2
    (best,) = re.findall(r"^The best of the trainings is (.*)", told, re.MULTILINE)
    succeed("evaluate", "--policy", best, "--episodes", "2")
    Path(best).unlink()
    again = command("sweep", tmp_path / "train.toml", "--out", tmp_path / "out")
    assert_one_clear_line(again, f"{best}: found no such file, expected the policy of a training")


SEARCH = """
[search]
trials = 2
total_timesteps = 1
episodes = 12
hyperparameters.hidden = [[32, 32]]
hyperparameters.learning_rate = { low = 1e-4, high = 1e-2, log = true }
"""


@pytest.mark.torch
def test_a_search_is_ray_s_alone(tmp_path):
    (tmp_path / "search.toml").write_text(SEARCH)
    done = command("sweep", "search.toml", cwd=tmp_path)
    assert_one_clear_line(
        done, "engine: found local beside a table .search., expected --engine ray"
    )


@pytest.mark.slow
@pytest.mark.torch
def test_trials_leave_rows_and_hyperparameters_to_train_with(tmp_path):
    pytest.importorskip("ray.tune")
    (tmp_path / "search.toml").write_text(SEARCH)
    told = succeed("sweep", tmp_path / "search.toml", "--out", tmp_path / "out", "--engine", "ray")
    (run,) = (tmp_path / "out").iterdir()
    best = read_hyperparameters(run / "hyperparameters.json", "ppo").learning_rate
    table = rows(tmp_path / "out").to_pylist()
    tried = {float(row["hyperparameters.learning_rate"]) for row in table}
    assert len(table) == 2 * 12 and len(tried) == 2 and best in tried and 1e-4 <= best <= 1e-2
    (train,) = re.findall(r"^mmwave-loc train .*", told, re.MULTILINE)
    assert train.endswith(f"--hyperparameters {run / 'hyperparameters.json'}")
    assert f"hyperparameters.learning_rate {best}" in told.splitlines()[2]  # the best comes first
    again = command("sweep", tmp_path / "search.toml", "--out", tmp_path / "out", "--engine", "ray")
    assert again.returncode == 0 and not re.search("^trial ", again.stderr, re.M)
    assert rows(tmp_path / "out").to_pylist() == table


def kill_once(words, folder, early_s, rng):
    """Start a sweep and kill it: at a random moment of its start, or soon after its next rows."""
    before = len(list(folder.rglob("[!.]*.parquet")))  # hidden ones are half written
    running = subprocess.Popen(
        [sys.executable, "-m", "experiments.console", *map(str, words)],
        cwd=ROOT, env=environment(),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip
    if early_s:
        time.sleep(rng.uniform(0.2, early_s))
    else:
        while len(list(folder.rglob("[!.]*.parquet"))) == before and running.poll() is None:
            time.sleep(0.05)
        time.sleep(rng.uniform(0.0, 0.5))
    assert running.poll() is None, "it was over before it could be killed"
    os.kill(running.pid, signal.SIGKILL)
    running.wait()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX has them")
@pytest.mark.parametrize("engine", ["local", "ray"])
def test_a_sweep_killed_ten_times_ends_equal_to_one_undisturbed(tmp_path, engine):
    if engine == "ray":
        pytest.importorskip("ray")
    seeds = ", ".join(map(str, range(0, 10_000, 100)))
    text = f'[evaluate]\npolicy = ["fixed-ekf", "fixed-ukf"]\nseed = [{seeds}]\nepisodes = 100\n'
    (tmp_path / "grid.toml").write_text(text)
    succeed("sweep", tmp_path / "grid.toml", "--out", tmp_path / "calm")
    words = ["sweep", tmp_path / "grid.toml", "--out", tmp_path / "killed", "--engine", engine]
    rng, start_s = random.Random(0), 2.0 if engine == "local" else 6.0
    for kill in range(10):
        kill_once(words, tmp_path / "killed", start_s if kill % 2 else 0.0, rng)
    done = command(*words)
    assert done.returncode == 0, done.stderr
    assert "200 cells" in done.stderr and "200 cells, 0 of them" not in done.stderr
    assert rows(tmp_path / "killed").drop(["run"]).equals(rows(tmp_path / "calm").drop(["run"]))
