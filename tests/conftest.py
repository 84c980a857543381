"""Settings for all tests, and a process that compiles common loops while tests are collected."""

import os
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec

# Tests of pictures need the extra ``render``; without it they are not collected.
collect_ignore_glob = [] if find_spec("pygame") else ["rendering/test_*.py"]

# Examples of Hypothesis may take any time: some compile. A few environments lack the package.
with suppress(ImportError):
    from hypothesis import settings

    settings.register_profile("tests", deadline=None)
    settings.load_profile("tests")

# Tests run in parallel, one per core, so more threads of torch and BLAS would only wait. Besides,
# threads do not survive a fork.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

# The loops that draw episodes and that step and reset environments take half a minute to compile,
# unless the disk cache has them.
LOOPS = """
import gymnasium as gym
env = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=8192, episode_steps=3)
env.reset(seed=0)
for _ in range(4):
    env.step(env.action_space.sample())
"""

compiling = []


def pytest_sessionstart(session):
    """Compile the loops once for all test processes, while the processes collect their tests."""
    # Only the process that starts the test processes has a value for this option.
    if getattr(session.config.option, "numprocesses", None):
        compiling.append(subprocess.Popen([sys.executable, "-c", LOOPS]))


def pytest_sessionfinish():
    for process in compiling:
        process.terminate()
        process.wait()
