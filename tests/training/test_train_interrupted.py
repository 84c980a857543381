"""Tests that a killed and continued training run writes the same files as an uninterrupted run."""

import csv
import io
import json
import multiprocessing
import os
import re
import signal
import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest

from tests import cli
from tests.paths import json_in
from tests.refusals import refuses

pytest.importorskip("stable_baselines3")

from experiments.training.evaluator import EPISODES
from experiments.training.job import Job
from experiments.training.ppo import PpoTraining
from experiments.training.processes import side_by_side
from mmwave_env.filters.bank import Bank, default_modes
from tests.training.actors import MODES
from tests.training.test_rollout_env import task
from tests.training.test_train import HYPER, TASK, content

pytestmark = [
    pytest.mark.torch,
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork"),
]

SMALL = replace(HYPER, num_envs=4, n_steps=25, batch_size=50, paired=True)
KINDS = {"ppo": SMALL, "places": replace(SMALL, first_action_bias=1.0)}
TASKS = {"ppo": TASK, "places": task(banks=dict.fromkeys(["handset", "standard"], Bank(MODES)))}
UPDATES = 14  # episodes end after every eighth update


def job_of(folder, kind="ppo", **changes):
    hyper = KINDS[kind]
    timesteps = UPDATES * hyper.num_envs * hyper.n_steps
    job = Job(TASKS[kind], hyper, 0, timesteps, folder, "mmwave-loc train", 1, 20)
    return replace(job, **changes)


def silent(*_):
    pass


def train(job):
    PpoTraining(job, silent).run()


def forked(job):
    """Start a forked process that trains with the functions compiled in this process."""
    process = multiprocessing.get_context("fork").Process(target=train, args=(job,))
    process.start()
    return process


def progress(folder):
    """Return the rows of the log as text, without wall time."""
    text = (folder / "progress.csv").read_text()
    rows = list(csv.DictReader(io.StringIO(text)))
    assert all(float(row.pop("seconds")) > 0.0 for row in rows)
    return rows


def untimed(outcome):
    outcome.pop("seconds")
    if outcome["beat_rule"]:
        outcome["beat_rule"].pop("seconds")
    return outcome


def assert_same_training(actual, expected):
    """Assert that two training runs wrote the same files, except for times."""
    for name in ("policy.safetensors", "latest.safetensors"):
        assert (actual / name).read_bytes() == (expected / name).read_bytes()
    assert progress(actual) == progress(expected)
    outcomes = [json_in(folder / "outcome.json") for folder in (actual, expected)]
    assert untimed(outcomes[0]) == untimed(outcomes[1])
    assert not (actual / "checkpoint.pt").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_training_killed_at_random_moments_continues_to_the_same_result(kind, tmp_path):
    job = job_of(tmp_path / "killed", kind)
    whole = job_of(tmp_path / "whole", kind)
    train(whole)  # compiles the functions that the forked processes run
    checkpoint = job.folder / "checkpoint.pt"
    rng = np.random.default_rng(5)
    kills = 0
    before = None
    while True:
        process = forked(job)
        while process.is_alive() and stamp(checkpoint) in (before, None):
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.05))
        process.kill()
        process.join()
        if process.exitcode == 0:
            break
        assert process.exitcode == -signal.SIGKILL
        kills = kills + 1
        before = stamp(checkpoint)
    assert kills >= 1
    assert_same_training(job.folder, whole.folder)


def stamp(path):
    """Return a value that changes whenever a file is replaced; None if there is no file."""
    try:
        return path.stat().st_ino, path.stat().st_mtime_ns
    except FileNotFoundError:
        return None


def test_a_training_killed_before_the_first_checkpoint_starts_over(tmp_path):
    job = job_of(tmp_path / "killed")
    whole = job_of(tmp_path / "whole")
    train(whole)
    job = replace(job, checkpoint_every=100)
    process = forked(job)
    while not job.policy.exists():
        time.sleep(0.001)
    process.kill()
    process.join()
    assert not (job.folder / "checkpoint.pt").exists()
    train(job)
    assert_same_training(job.folder, whole.folder)


def test_training_runs_with_different_seeds_differ(tmp_path):
    for seed in range(2):
        train(job_of(tmp_path / str(seed), seed=seed))
    a, b = ((tmp_path / str(seed) / "latest.safetensors").read_bytes() for seed in range(2))
    assert a != b


# --- processes


def outcome(seed):
    """Return the outcome that a training process writes."""
    best = {"reward": 0.5, "timesteps": 100}
    return {"seed": seed, "timesteps": 200, "seconds": 1.5, "beat_rule": None, "best": best}


def finished(folder, seed):
    folder.mkdir(parents=True)
    (folder / "outcome.json").write_text(json.dumps(outcome(seed)))
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


def gone(group):
    """Return whether a process group ends within a minute."""
    return any(not members(group) or time.sleep(0.1) for _ in range(600))


def until_replaced(path, process):
    before = stamp(path)
    while stamp(path) in (before, None):
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)


def test_an_interrupted_command_ends_all_processes_and_continues_when_resumed(tmp_path, started):
    """Kill the command, kill its training process, press Ctrl-C, and send SIGTERM."""
    street = replace(TASK, banks={"handset": Bank(default_modes("handset"))})
    job = job_of(tmp_path / "whole", task=street)
    # The training must take seconds, so that it can be interrupted.
    job = replace(job, timesteps=10 * job.timesteps, episodes=EPISODES)
    hyperparameters = tmp_path / "mine.json"
    out = tmp_path / "run"
    hyperparameters.write_text(json.dumps(content(KINDS["ppo"])))
    length = ("--seeds", 1, "--total-timesteps", job.timesteps)
    made_with = (*length, "--hyperparameters", hyperparameters)
    words = (*made_with, "--out", out, "--checkpoint-every", 1, "--jobs", 1)
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
        command = started(*words, *["--resume"] * out.exists())
        until_replaced(checkpoint, command)
        send(command.pid)
        output, errors = command.communicate(timeout=600)
        assert command.returncode == code and output == "" and "Traceback" not in errors
        if message:
            assert re.fullmatch(f"mmwave-loc train: {message}", errors.splitlines()[-1])
            assert not list(out.rglob(".*"))
        assert gone(command.pid)  # training processes end, too

    command = started(*words, "--resume")
    summary, _ = command.communicate(timeout=1800)
    assert command.returncode == 0 and "| seed | reward |" in summary
    train(replace(job, command=" ".join(map(str, ("mmwave-loc", "train", *made_with)))))
    assert_same_training(out / "seed-0", job.folder)
    policy = (out / "policy.safetensors").read_bytes()
    assert policy == (job.folder / "policy.safetensors").read_bytes()
    assert json_in(out / "summary.json")["median"] == 0
