"""Tests that commands leave complete files or none, even after a signal or on a full disk."""

import os
import random
import shutil
import signal
import sys
import time
from contextlib import suppress

import pytest

from experiments.console.main import main
from tests.cli import succeed
from tests.paths import RIDE

with suppress(ImportError):  # systems without fork lack this module, too
    import resource

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")]
SIGNALS = {signal.SIGINT, signal.SIGTERM}
# required number of interruptions of a command, maximum number of tries
HITS = 3
TRIES = 15
PRINTED = "printed.txt"  # file with a command's output, outside the folder where it runs
LOG = str(RIDE / "log.csv")
SCENE = str(RIDE / "scene.json")
FEW = ("--episodes", "4", "--episode-steps", "30")
COMMANDS = {
    "localize": ("localize", LOG, "--scene", SCENE, "--speed", "auto", "--out", "track.tum",
                 "--json", "track.json"),
    "compare": ("compare", "--policies", "fixed-ekf", "speed-rule", *FEW, "--json", "c.json",
                "--episodes-csv", "c.csv"),
    "simulate": ("simulate", "--seed", "7", "--out", "made"),
    "report": ("report", "c.json", "--episodes", "1", "--out", "page.html"),
    "watch": ("watch", "--policies", "fixed-ekf", "--seed", "3", "--end", "8", "--out", "film.gif"),
    "tune": ("tune", "--modes", "ekf", "--scenarios", "pedestrian", "--free", "sigma_v",
             "--episodes", "2", "--out", "modes.json"),
}  # fmt: skip
INTERRUPTIONS = {  # name -> signal sent (None: file sizes are limited), exit codes if interrupted
    "KILL": (signal.SIGKILL, {-signal.SIGKILL}),
    "TERM": (signal.SIGTERM, {-signal.SIGTERM, 128 + signal.SIGTERM}),
    "INT": (signal.SIGINT, {-signal.SIGINT, 128 + signal.SIGINT}),
    "full disk": (None, {2}),
}


def contents(folder):
    """Read all files except hidden ones, which a killed command may leave behind."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.parts)
    }


def begun(words, folder, most):
    """Start a command that may write ``most`` bytes per file (None: any number); return its PID."""
    (folder.parent / PRINTED).write_text("")
    # A signal that comes before the child has its own handlers would raise an error in pytest.
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        return child
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        output = os.open(f"../{PRINTED}", os.O_WRONLY)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", closefd=False)
        if most is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        sys.argv = ["mmwave-loc", *words]
        main()
        code = 0
    except SystemExit as end:
        code = int(end.code or 0)
    except KeyboardInterrupt:  # the signal came before the command began
        code = 128 + signal.SIGINT
    finally:
        os._exit(code)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Return a function from a command's name to its input folder, outputs and duration (s)."""
    known = {}

    def find(name):
        if name not in known:
            inputs = tmp_path_factory.mktemp(name) / "given"
            inputs.mkdir()
            if name == "report":
                succeed(*COMMANDS["compare"], cwd=inputs)
                (inputs / "c.csv").unlink()
            made = shutil.copytree(inputs, inputs.parent / "made")
            again = shutil.copytree(inputs, inputs.parent / "again")
            succeed(*COMMANDS[name], cwd=made)
            begin = time.monotonic()
            # By now everything is compiled in this process, and thus in its forks.
            succeed(*COMMANDS[name], cwd=again)
            known[name] = inputs, contents(made), time.monotonic() - begin
            assert contents(again) == contents(made)
        return known[name]

    return find


@pytest.mark.parametrize("kind", INTERRUPTIONS)
@pytest.mark.parametrize("name", COMMANDS)
def test_an_interrupted_command_leaves_complete_files_or_none(name, kind, undisturbed, tmp_path):
    inputs, whole, longest_s = undisturbed(name)
    sent, codes = INTERRUPTIONS[kind]
    rng = random.Random(f"{name} {kind}")
    hits = 0
    largest = max(len(content) for content in whole.values())
    for number in range(TRIES):
        folder = shutil.copytree(inputs, tmp_path / str(number))
        begin = time.monotonic()
        child = begun(COMMANDS[name], folder, None if sent else rng.randrange(largest))
        if sent:
            time.sleep(rng.uniform(0.0, longest_s))
            os.kill(child, sent)
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        output = (tmp_path / PRINTED).read_text()
        assert code in codes | {0} and "Traceback" not in output, output
        written = contents(folder)
        assert [file for file in written if written[file] != whole.get(file)] == []
        assert {path.name for path in inputs.iterdir()} <= written.keys()
        assert sent == signal.SIGKILL or not [*folder.rglob(".*")]
        hits += code in codes
        if hits == HITS:
            return
        longest_s = min(longest_s, time.monotonic() - begin)
    raise AssertionError(f"found {hits} interruptions in {TRIES} tries, expected {HITS}")
