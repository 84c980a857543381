"""Time to the first step, and peak memory, each in a fresh process.

The time begins before Python does, so imports and compilation are in it. What other runs have
left on disk (bytecode, compiled loops) is used, as a second run would.
"""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

STEPS = 210  # through the end of all episodes and the drawing of the next ones


def fresh(name: str, n: int) -> tuple[float, float]:
    """Start Python, make an environment and step it.

    Args:
        name: as in ``gymnasium.make``.
        n: how many in a vector environment; 0 for a single one.

    Returns:
        Seconds from its start to the end of the first step, and the most resident memory through
        the ends of episodes, MiB (2^20 bytes).
    """
    words = [sys.executable, "-m", __name__, name, str(n)]
    packages = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}  # as here
    begin = time.perf_counter()
    with subprocess.Popen(words, env=packages, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        child.stdout.readline()
        first_step_s = time.perf_counter() - begin
        peak_mb = child.stdout.readline()
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, words)
    return first_step_s, float(peak_mb)


def _step(name: str, n: int) -> None:
    """What the process does: a line after the first step, and its peak at the end."""
    import gymnasium as gym
    import numpy as np

    env: Any = gym.make_vec(name, num_envs=n) if n else gym.make(name)
    actions: Any = np.ones(n, np.int64) if n else np.int64(1)
    env.reset(seed=0)
    env.step(actions)
    print("stepped", flush=True)
    for _ in range(STEPS):
        _, _, terminated, truncated, _ = env.step(actions)
        if n == 0 and (terminated or truncated):
            env.reset()
    print(_peak_mb())


def _peak_mb() -> float:
    status = Path("/proc/self/status")
    if status.exists():  # not ru_maxrss there: a child inherits that of its parent
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    import resource

    unit = 1024**2 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit


if __name__ == "__main__":
    _step(sys.argv[1], int(sys.argv[2]))
