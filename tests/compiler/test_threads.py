"""Tests of sharing jobs among threads, and of environments that use several threads."""

import os
import subprocess
import sys
import textwrap
import threading

import pytest

from mmwave_env.compiler.program import share
from tests.cli import environment


@pytest.mark.parametrize(("jobs", "threads"), [(0, 2), (1, 2), (2, 50), (20, 1), (20, 3)])
def test_results_are_in_the_order_of_the_jobs(jobs, threads):
    assert share(lambda a, b: a * b, [(i, 2) for i in range(jobs)], threads) == [
        2 * i for i in range(jobs)
    ]


def test_an_error_in_any_thread_is_raised_and_the_next_call_works():
    with pytest.raises(ZeroDivisionError):
        share(lambda i: 1 / i, [(i,) for i in range(8)], 2)
    me = threading.get_ident()
    begun = threading.Event()

    def job(i):
        if threading.get_ident() != me:
            begun.set()
            raise KeyError(i)
        begun.wait(10.0)
        return i

    with pytest.raises(KeyError):
        share(job, [(i,) for i in range(9)], 2)
    assert share(lambda i: i, [(i,) for i in range(9)], 2) == list(range(9))


def test_a_job_can_itself_distribute_jobs_over_threads():
    """Check that there is no deadlock although each of 200 jobs waits for jobs of its own."""

    def job(i):
        return share(lambda j: i + j, [(j,) for j in range(4)], 4)

    results = share(job, [(i,) for i in range(200)], 50)
    assert results == [[i + j for j in range(4)] for i in range(200)]


# --- environments in new processes

STEPPED = """
import os, signal, sys, threading, time
import gymnasium as gym
import numpy as np
import mmwave_env.engines.batch as batch
import mmwave_env.compiler.program as stepping
from mmwave_env.compiler.program import share

batch.BLOCKS_PER_THREAD = 1

def stepped(seed=0, steps=3, **arguments):
    env = gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=32, modes=["ekf"], **arguments)
    env.reset(seed=seed)
    return env, [env.step(np.zeros(32, int))[1] for _ in range(steps)]

if __name__ == "__main__":
    # A process that a shell starts in the background ignores SIGINT by default.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    env, rewards = stepped(threads=2)
"""


def process(code, tmp_path):
    """Run a program that steps an environment and then runs ``code``; return the printed words."""
    program = tmp_path / "program.py"  # spawned processes need a file
    program.write_text(STEPPED + textwrap.indent(textwrap.dedent(code), "    "))
    run = {"capture_output": True, "text": True, "timeout": 120}
    done = subprocess.run([sys.executable, program], env=environment(), **run)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


posix = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and signals")


@pytest.mark.slow
@posix
def test_after_an_interrupt_the_running_jobs_end_and_no_new_job_begins(tmp_path):
    code = """
    begun, done = threading.Event(), []
    def job(i):
        if threading.current_thread() is threading.main_thread():
            begun.wait(10.0)
            signal.raise_signal(signal.SIGINT)
        begun.set()
        time.sleep(0.2)
        done.append(i)
    try:
        share(job, [(i,) for i in range(6)], 2)
    except KeyboardInterrupt:
        print("interrupted", len(done))
        time.sleep(0.5)
        print(len(done))
    """
    assert process(code, tmp_path) == ["interrupted", "1", "1"]


@pytest.mark.slow
@posix
def test_an_environment_continues_after_an_interrupted_step(tmp_path):
    """Check that the metrics include the actions and the results of the interrupted step."""
    code = """
    def interrupted(*arguments):
        stepping.share = share
        share(*arguments)
        raise KeyboardInterrupt
    env, twin = (
        gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=32, episode_steps=9, threads=2,
                     modes=["ekf", "ekf-robust"])
        for _ in range(2)
    )
    for each in env, twin:
        each.reset(seed=0)
    for step in range(8):
        twin.step(np.full(32, step % 2))
        stepping.share = interrupted if step == 4 else share
        try:
            env.step(np.full(32, step % 2))
        except KeyboardInterrupt:
            print("interrupted")
    (*_, over, infos), (*_, expected) = (each.step(np.ones(32, int)) for each in (env, twin))
    print(over.all(), all(np.array_equal(infos[key], value) for key, value in expected.items()))
    """
    assert process(code, tmp_path) == ["interrupted", "True", "True"]


@posix
@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn", "forkserver"])
def test_environments_can_run_in_their_own_processes(context, tmp_path):
    code = f"""
    import warnings
    warnings.simplefilter("ignore")  # newer versions of Python warn about forks with threads
    one = lambda: gym.make("mmwave_env:MmWaveLoc-v0", modes=["ekf"])
    found = gym.vector.AsyncVectorEnv([one] * 2, context="{context}")
    expected = gym.vector.SyncVectorEnv([one] * 2)
    for env in (found, expected):
        env.reset(seed=3)
    for _ in range(3):
        a, b = (env.step(np.zeros(2, int)) for env in (found, expected))
        print(*(np.array_equal(x, y) for x, y in zip(a[:4], b[:4])))
    found.close()
    """
    assert process(code, tmp_path) == ["True"] * 12
