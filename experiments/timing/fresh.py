"""Time to the first step, and peak memory, measured in a new process.

The time includes the start of Python, imports and compilation. Files that earlier runs left on
disk (bytecode, compiled loops) are used, so a first run on a machine takes longer.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ENVIRONMENT = "mmwave_env:MmWaveLoc-v0"
STEPS = 210  # number of steps: enough to end all episodes and to draw new episodes


def fresh(n: int) -> tuple[float, float]:
    """Start Python, make an environment in it, and measure the time and memory of steps.

    ``n`` is the number of environments in a vector environment; 0 for a single environment. Return
    two values: the seconds from Python's start to the end of the first step, and the peak resident
    memory, MiB (2^20 bytes), in a run that is longer than an episode.
    """
    begin = time.perf_counter()
    with started(__name__, str(n)) as child:
        child.stdout.readline()
        first_step_s = time.perf_counter() - begin
        peak_mb = child.stdout.readline()
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, child.args)
    return first_step_s, float(peak_mb)


def started(*words: str, **options: Any) -> Any:
    """Start a Python module, with arguments, in a process that finds the same packages as this one.

    ``options`` are options of the process. The process prints to a pipe.
    """
    packages = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", *words]
    return subprocess.Popen(command, env=packages, stdout=subprocess.PIPE, **options)


def _step(n: int) -> None:
    """Step in the new process; print a line after the first step, and peak memory at the end."""
    import gymnasium as gym
    import numpy as np

    env = gym.make_vec(ENVIRONMENT, num_envs=n) if n else gym.make(ENVIRONMENT)
    actions = np.ones(n, np.int64) if n else np.int64(1)
    env.reset(seed=0)
    env.step(actions)
    print("stepped", flush=True)
    for _ in range(STEPS):
        _, _, terminated, truncated, _ = env.step(actions)
        if n == 0 and (terminated or truncated):
            env.reset()
    status = Path("/proc/self/status")
    if status.exists():  # on Linux ru_maxrss would include the memory of the parent
        print(int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024)
        return
    import resource

    unit = 1024**2 if sys.platform == "darwin" else 1024
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


if __name__ == "__main__":
    _step(int(sys.argv[1]))
