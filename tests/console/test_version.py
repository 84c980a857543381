"""Tests of ``mmwave-loc --version --json``, and of a signal while kernels are compiled."""

import json
import os
import signal
import subprocess
import time

import pytest

import mmwave_env
from tests.cli import command, environment, started


def test_versions_and_kernels_are_reported():
    done = command("--version", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == 0 and report["versions"]["mmwave-loc"] == mmwave_env.__version__
    assert {"numba", "numpy", "gymnasium", "python"} < set(report["versions"])
    assert report["kernels"]["functions"] > 0 and os.path.isdir(report["kernels"]["place"])


@pytest.mark.slow
def test_a_signal_ends_a_command_while_it_compiles(tmp_path):
    cold = environment() | {"NUMBA_CACHE_DIR": str(tmp_path)}
    nowhere = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = started("compare", "--policies", "imm-best", env=cold, **nowhere)
    while not any(path.is_file() for path in tmp_path.rglob("*")):
        assert running.poll() is None
        time.sleep(0.05)
    running.send_signal(signal.SIGTERM)
    assert running.wait(timeout=60.0) == 128 + signal.SIGTERM
