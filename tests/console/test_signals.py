"""Tests that a command cleans up if a signal (such as SIGINT after Ctrl-C) ends it."""

import os
import signal
import subprocess
import time
from functools import partial

import pytest

from experiments.console.signals import ENDING, heed_signals
from tests.cli import environment, started

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")

# A command that pauses in the middle of writing its result, after it printed "writing".
WRITING = """
import sys, time
from pathlib import Path
import experiments.tables
from experiments.console.main import run
from mmwave_env.io.files import atomic_path

def writing(args):
    with atomic_path(Path(sys.argv[1])) as temporary:
        temporary.write_text("half of the ne")
        print("writing", flush=True)
        time.sleep(60)

experiments.tables.main = writing
run("tables", [])
"""


def heed():
    """Let signals end this process, even if its parent, such as nohup, ignores them."""
    for number in (signal.SIGINT, *ENDING):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def writing(tmp_path):
    """Return a function that starts WRITING, waits for "writing" and returns the process."""
    begun = []

    def start(before=heed):
        program = ("-c", WRITING)
        begun.append(started(tmp_path / "result.json", program=program, preexec_fn=before))
        assert begun[-1].stdout.readline() == "writing\n"
        return begun[-1]

    yield start
    for process in begun:
        process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, *ENDING])
def test_a_signal_removes_half_written_files(writing, tmp_path, sent):
    command = writing()
    assert len(list(tmp_path.iterdir())) == 1
    command.send_signal(sent)
    # A scheduler may send SIGTERM or SIGHUP twice: to the process and, shortly after, to its group.
    time.sleep(0.003)
    command.send_signal(sent if sent in ENDING else 0)
    out, err = command.communicate(timeout=30)
    assert command.returncode == 128 + sent and out == ""
    end = "interrupted" if sent == signal.SIGINT else f"ended by {sent.name}"
    assert err == f"mmwave-loc tables: {end}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_command_cleans_up_even_if_its_terminal_is_gone(writing, tmp_path):
    command = writing()
    command.stderr.close()
    command.stdout.close()
    command.send_signal(signal.SIGHUP)
    assert command.wait(timeout=30) == 128 + signal.SIGHUP
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_under_nohup_a_command_continues_after_its_terminal_is_closed(writing, tmp_path):
    command = writing(partial(signal.signal, signal.SIGHUP, signal.SIG_IGN))
    command.send_signal(signal.SIGHUP)
    time.sleep(0.2)
    assert command.poll() is None and len(list(tmp_path.iterdir())) == 1


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


def test_a_signal_raises_a_keyboard_interrupt_and_the_next_ones_are_ignored():
    before = {number: signal.getsignal(number) for number in ENDING}
    try:
        heed_signals()
        with pytest.raises(KeyboardInterrupt) as end:
            signal.raise_signal(signal.SIGTERM)
        assert end.value.args == (signal.SIGTERM,)
        signal.raise_signal(signal.SIGHUP)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
