"""Tests of ``mmwave-loc sweep``, which stores a result for each cell (combination of values)."""

import os
import re
import signal
import subprocess
import time

import pytest

from experiments.sweeping.run import RETRIES, computed, connected
from tests.cli import assert_refused, command, started, succeed

pytest.importorskip("pyarrow")
pytest.importorskip("ray")

SMALL = """
[evaluate]
policy = ["fixed-ekf", "imm"]
seed = [0, 3]
episodes = 3
episode_steps = 30
"""


def written(folder, text):
    (folder / "grid.toml").write_text(text)
    return folder / "grid.toml"


def rows(out):
    """Return the results of all cells in a folder, each as a dict."""
    from pyarrow import dataset

    return dataset.dataset(out, format="parquet", exclude_invalid_files=True).to_table().to_pylist()


def written_ns(paths):
    """Return when files were written, by their paths."""
    return {path: path.stat().st_mtime_ns for path in paths}


def wait_for_rows(out, running, count):
    while len(list(out.glob("[!.]*.parquet"))) < count and running.poll() is None:
        time.sleep(0.05)
    assert running.poll() is None, running.communicate()


def ray_processes():
    """Return the ids of all processes of the package Ray."""
    listed = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True).stdout
    return set(re.findall(r"^ *(\d+) .*(?:ray::|raylet|gcs_)", listed, re.MULTILINE))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["there.toml"], "there.toml: found no such file, expected a sweep, TOML"),
        (["there.toml", "--workers", "0"], "workers: found 0, expected at least 1"),
    ],
)
def test_mistakes_end_with_one_clear_line(tmp_path, words, message):
    assert_refused(message, "sweep", *words, cwd=tmp_path)


def squared(values):
    """Return the square of a number, except that 0 raises an error and 4 ends the process.

    For 1, the first call makes the file ``mark`` and raises the error of a full disk.
    """
    number = values["number"]
    mark = values["mark"]
    if number == 0:
        raise ValueError("no 0\nand no more")
    if number == 1 and not os.path.exists(mark):
        open(mark, "x").close()
        raise OSError(28, "No space left on device")
    if number == 4:
        os._exit(3)
    return {"square": number**2}


@pytest.mark.slow
def test_cells_that_fail_do_not_affect_others(tmp_path):
    mark = str(tmp_path / "mark")
    cells = {str(number): {"number": number, "mark": mark} for number in range(5)}
    with connected(None, 2):
        outcomes = {name: (row, error) for name, row, error in computed(squared, cells)}
    assert outcomes["0"] == (None, "ValueError: no 0")
    assert outcomes["4"] == (None, f"its process ended {RETRIES + 1} times (WorkerCrashedError)")
    assert [outcomes[str(n)][0]["square"] for n in (1, 2, 3)] == [1, 4, 9]


@pytest.mark.slow
def test_rows_equal_the_results_of_compare_and_new_cells_are_added(tmp_path):
    file = written(tmp_path, SMALL.replace(', "imm"]', "]"))
    out = tmp_path / "out"
    succeed("sweep", file, "--out", out, "--workers", "1")
    before = written_ns(out.iterdir())
    larger = written(tmp_path, SMALL.replace('"imm"', '"imm", "nobody"'))
    done = command("sweep", larger, "--out", out)
    assert done.returncode == 2 and "6 cells, 2 of them already in" in done.stderr
    assert re.search(r"^failed: policy nobody, seed 3, .*found 'nobody'", done.stderr, re.MULTILINE)
    assert "2 of 6 cells failed, the others are in" in done.stderr
    assert written_ns(before) == before and len(rows(out)) == 4
    for row in rows(out):
        words = ["--policies", row["policy"], "--seed", row["seed"], "--episodes", "3"]
        succeed("compare", *words, "--episode-steps", "30", "--episodes-csv", tmp_path / "rows.csv")
        header, *lines = (tmp_path / "rows.csv").read_text().splitlines()
        column = header.split(",").index("ate_m")
        assert row["ate_m_each"] == [float(line.split(",")[column]) for line in lines]
        assert row["ate_m_mean"] == pytest.approx(sum(row["ate_m_each"]) / 3)
        assert row["ate_m_low"] <= row["ate_m_mean"] <= row["ate_m_high"]


@pytest.mark.slow
@pytest.mark.release
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_a_killed_or_interrupted_sweep_can_be_continued_and_leaves_no_process(tmp_path):
    others = ray_processes()
    out = tmp_path / "out"
    file = written(tmp_path, SMALL.replace("[0, 3]", "[0, 3, 6, 9]").replace("= 3", "= 200"))
    for number, code in ((signal.SIGKILL, -9), (signal.SIGINT, 130)):
        running = started("sweep", file, "--out", out, "--workers", "1")
        wait_for_rows(out, running, len(list(out.glob("*.parquet"))) + 1)
        running.send_signal(number)
        _, errors = running.communicate(timeout=60)
        assert running.returncode == code, errors
    assert errors.splitlines()[-1] == "mmwave-loc sweep: interrupted"
    until = time.monotonic() + 60.0
    while ray_processes() - others and time.monotonic() < until:
        time.sleep(0.5)
    assert not ray_processes() - others
    kept = written_ns(out.glob("[!.]*.parquet"))
    assert 2 <= len(kept) < 8
    succeed("sweep", file, "--out", out)
    assert len(rows(out)) == 8 and written_ns(kept) == kept


TRAIN = """
[train]
total_timesteps = 1
episodes = 12
hyperparameters.num_envs = 8
hyperparameters.n_steps = 64
hyperparameters.learning_rate = 1e-3
"""


@pytest.mark.slow
@pytest.mark.torch
def test_the_policies_of_training_runs_are_kept(tmp_path):
    shown = succeed("sweep", written(tmp_path, TRAIN), "--out", tmp_path / "out")
    (best,) = re.findall(r"^The best of the trainings is (.*)", shown, re.MULTILINE)
    (row,) = (tmp_path / "out").glob("*.parquet")
    assert best == str(row.with_suffix(".safetensors"))
    succeed("compare", "--policies", best, "--episodes", "2")
