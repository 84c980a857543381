"""Tests that a training that was interrupted goes on, and keeps the seeds that had finished."""

import multiprocessing
import os
import re
import signal
import subprocess
import time
from dataclasses import replace
from functools import partial

import pytest

from tests import cli
from tests.paths import json_in, records, write_json
from tests.refusals import refuses

pytest.importorskip("stable_baselines3")

from experiments.training.run import side_by_side, train
from experiments.training.trainer import run_training
from tests.training import test_train
from tests.training.test_train import HYPER, content

pytestmark = [
    pytest.mark.torch,
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork"),
]

SMALL = replace(HYPER, num_envs=4, n_steps=25, batch_size=50, paired=True)
STEPS = 14 * SMALL.num_envs * SMALL.n_steps
job_of = partial(test_train.job_of, hyperparameters=SMALL, timesteps=STEPS)


def silent(*_):
    pass


def trained(job, algorithm):
    """Run a training; return its trainer."""
    trainers = []

    def make(*arguments):
        trainers.append(algorithm(*arguments))
        return trainers[0]

    run_training(job, make, silent)
    return trainers[0]


class Interrupted(Exception):
    pass


def interrupt_after(calls):
    """Return a callback that does nothing ``calls`` times and then interrupts the training."""
    left = iter(range(calls))

    def tell(*_):
        if next(left, None) is None:
            raise Interrupted

    return tell


def assert_goes_on(job):
    """Interrupt a training twice, let it finish, and check it."""
    for calls in (0, 1):
        with pytest.raises(Interrupted):
            train(job, interrupt_after(calls))
        assert job.checkpoint.exists()
    outcome = train(job, silent)
    assert outcome == json_in(job.outcome) and outcome["timesteps"] >= job.timesteps
    assert job.policy.exists() and not job.checkpoint.exists()
    rows = records(job.folder / "progress.csv")
    steps = [int(row["timesteps"]) for row in rows]
    assert steps == sorted(set(steps)) and steps[-1] == outcome["timesteps"]


def stamp(path):
    """Return a value that changes whenever a file is replaced; None if there is no file."""
    try:
        return path.stat().st_ino, path.stat().st_mtime_ns
    except FileNotFoundError:
        return None


def test_an_interrupted_training_goes_on(tmp_path):
    assert_goes_on(job_of(tmp_path))


# --- processes


def outcome(seed):
    """Return the outcome that a training process writes."""
    best = {"reward": 0.5, "timesteps": 100}
    return {"seed": seed, "timesteps": 200, "seconds": 1.5, "best": best}


def finished(folder, seed):
    folder.mkdir(parents=True)
    write_json(folder / "outcome.json", outcome(seed))
    return job_of(folder, seed=seed)


def test_finished_training_runs_are_not_repeated(tmp_path):
    jobs = [finished(tmp_path / f"{seed}", seed) for seed in range(3)]
    assert side_by_side(jobs, 2, silent) == [outcome(seed) for seed in range(3)]
    assert not multiprocessing.active_children()


def test_a_damaged_checkpoint_ends_all_training_processes(tmp_path):
    jobs = [job_of(tmp_path / f"{seed}", seed=seed) for seed in range(3)]
    jobs[1].folder.mkdir()
    (jobs[1].folder / "checkpoint.pt").write_bytes(b"damaged")
    with refuses("seed 1", "checkpoint.pt"):
        side_by_side(jobs, 2, silent)
    assert not multiprocessing.active_children()
    assert not jobs[2].folder.exists()


# --- the command


@pytest.fixture
def started():
    """Return a function that starts ``mmwave-loc train`` in a process group of its own.

    After the test, processes that remain in the groups are killed.
    """
    commands = []
    # Make Ctrl-C work even if a shell runs the tests in the background, where it is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def start(*words):
        commands.append(cli.started("train", *words, start_new_session=True))
        return commands[-1]

    yield start
    for command in commands:
        if members(command.pid):
            os.killpg(command.pid, signal.SIGKILL)
        command.communicate()
    signal.signal(signal.SIGINT, before)


def members(group):
    """Return ids and commands of the processes in a process group."""
    words = ["ps", "-ww", "-eo", "pgid=,pid=,args="]
    listed = subprocess.run(words, capture_output=True, text=True).stdout
    rows = [line.split(None, 2) for line in listed.splitlines()]
    return {int(pid): args for number, pid, args in rows if int(number) == group}


def until_replaced(path, process):
    before = stamp(path)
    while stamp(path) in (before, None):
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)


def test_an_interrupted_command_ends_all_processes_and_continues_when_resumed(tmp_path, started):
    """Kill the command, kill its training process, press Ctrl-C, and send SIGTERM."""
    hyperparameters = write_json(tmp_path / "mine.json", content(SMALL))
    out = tmp_path / "run"
    # The training must take seconds, so that it can be interrupted.
    length = ("--seeds", 1, "--total-timesteps", 10 * STEPS)
    made_with = (*length, "--hyperparameters", hyperparameters)
    words = (*made_with, "--out", out, "--jobs", 1)
    checkpoint = out / "seed-0" / "checkpoint.pt"

    def kill_the_training(group):
        os.killpg(group, signal.SIGSTOP)
        (training,) = (pid for pid, args in members(group).items() if "spawn_main" in args)
        os.kill(training, signal.SIGKILL)
        os.killpg(group, signal.SIGCONT)

    interruptions = {  # last line of errors -> exit code, and function that interrupts the command
        "": (-signal.SIGKILL, lambda pid: os.kill(pid, signal.SIGKILL)),
        "seed 0: its process ended with code -9; .*": (2, kill_the_training),
        "interrupted": (130, lambda pid: os.killpg(pid, signal.SIGINT)),  # as Ctrl-C does
        "ended by SIGTERM": (143, lambda pid: os.kill(pid, signal.SIGTERM)),
    }
    for message, (code, send) in interruptions.items():
        command = started(*words, *(["--resume"] if out.exists() else []))
        until_replaced(checkpoint, command)
        send(command.pid)
        output, errors = command.communicate(timeout=600)
        assert command.returncode == code and output == "" and "Traceback" not in errors
        if message:
            assert re.fullmatch(f"mmwave-loc train: {message}", errors.splitlines()[-1])
            assert not list(out.rglob(".*"))
        # Within a minute, training processes end, too.
        assert any(not members(command.pid) or time.sleep(0.1) for _ in range(600))

    command = started(*words, "--resume")
    summary, _ = command.communicate(timeout=1800)
    assert command.returncode == 0 and "| seed | reward |" in summary
    assert not checkpoint.exists()
    policy = (out / "policy.safetensors").read_bytes()
    assert policy == (out / "seed-0" / "policy.safetensors").read_bytes()
    assert json_in(out / "summary.json")["median"] == 0
