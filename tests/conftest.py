"""Fixtures and options of all tests."""

import os
import subprocess
import sys
from importlib.util import find_spec

# Pictures need the extra ``render``; without it their tests are left out.
collect_ignore_glob = [] if find_spec("pygame") else ["rendering/test_*.py"]

# Tests run side by side, one to a core; threads of torch and BLAS on top only wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The loops that draw, step and repeat episodes take half a minute to compile, where they are not
# on disk yet; until then they run as plain Python.
LOOPS = """
import gymnasium as gym
env = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=8192, episode_steps=3)
env.reset(seed=0)
for _ in range(4):
    env.step(env.action_space.sample())
"""

compiling = []


def pytest_sessionstart(session):
    """Compile the loops once for all processes that run tests, while these collect theirs."""
    if getattr(session.config.option, "numprocesses", None):  # the process that starts the others
        compiling.append(subprocess.Popen([sys.executable, "-c", LOOPS]))


def pytest_sessionfinish():
    for process in compiling:
        process.terminate()
        process.wait()
