"""Tests of ``mmwave-loc --version --json``, which also tests kernels (compiled functions)."""

import json
import os
import signal
import subprocess
import time

import pytest

import mmwave_env
from experiments.console import version
from tests.cli import command, environment, started


@pytest.mark.slow  # compiles a program of five modes
def test_versions_kernels_and_a_self_test_are_reported():
    done = command("--version", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == 0 and report["versions"]["mmwave-loc"] == mmwave_env.__version__
    assert {"numba", "numpy", "gymnasium", "python"} < set(report["versions"])
    assert report["kernels"]["functions"] > 0 and os.path.isdir(report["kernels"]["place"])
    assert len(report["self_test"]) == 4 and all(test["passed"] for test in report["self_test"])
    assert 0.0 <= max(test["deviation"] for test in report["self_test"]) < 1e-9


def test_the_program_ends_with_code_1_if_a_kernel_fails_the_self_test(monkeypatch):
    monkeypatch.setattr(version, "self_test", lambda: [{"kernel": "x", "passed": False}])
    done = command("--version", "--json")
    assert done.returncode == 1 and not json.loads(done.stdout)["self_test"][0]["passed"]


@pytest.mark.slow
def test_a_signal_ends_the_self_test_while_it_compiles(tmp_path):
    cold = environment() | {"NUMBA_CACHE_DIR": str(tmp_path)}
    nowhere = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = started("--version", "--json", env=cold, **nowhere)
    while not any(path.is_file() for path in tmp_path.rglob("*")):
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(signal.SIGTERM)
    assert running.wait(timeout=60.0) == 128 + signal.SIGTERM
