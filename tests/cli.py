"""Helpers that run the command-line program in the process of the tests or in another process."""

import os
import re
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from io import BytesIO, StringIO, TextIOWrapper
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from experiments.console.main import main
from tests.paths import ROOT, json_in


def command(*words, cwd=ROOT, columns=200, stdin=b""):
    """Run ``mmwave-loc <words>`` in this process as if typed; return its exit code and output.

    User warnings are shown as the program shows them; other warnings are errors, as in all tests.
    An exception that the program does not expect ends the command with code 1.
    """
    out = TextIOWrapper(BytesIO(), "utf-8", write_through=True)  # like most terminals
    err = StringIO()
    before = os.getcwd()
    typed = ["mmwave-loc", *map(str, words)]
    # The program replaces warnings.showwarning; catch_warnings restores it.
    with (
        patch.object(sys, "argv", typed),
        patch.object(sys, "stdin", TextIOWrapper(BytesIO(stdin))),
        patch.dict(os.environ, COLUMNS=str(columns)),
        warnings.catch_warnings(),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        warnings.simplefilter("default", UserWarning)
        os.chdir(cwd)
        try:
            main()
            code = 0
        except SystemExit as end:
            code = end.code
        finally:
            os.chdir(before)
    return subprocess.CompletedProcess(
        typed, code or 0, out.buffer.getvalue().decode(), err.getvalue()
    )


def environment():
    """Return environment variables for processes that import this checkout and print wide lines."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return os.environ | {"PYTHONPATH": path, "COLUMNS": "200"}


def python(code):
    """Run Python code in another process, which imports this checkout; return the process."""
    words = [sys.executable, "-c", code]
    return subprocess.run(words, cwd=ROOT, env=environment(), capture_output=True, text=True)


def printed(code):
    """Run Python code in another process, check that it succeeds, and return what it prints."""
    done = python(code)
    assert done.returncode == 0, done.stderr
    return done.stdout


def started(*words, program=("-m", "experiments.console"), **options):
    """Start ``mmwave-loc <words>`` with pipes for output; return the new process.

    Another ``program`` of Python may get the words instead.

    The options are passed to ``subprocess.Popen``; they override the usual arguments.
    """
    usual = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    usual |= {"env": environment(), "cwd": ROOT}
    words = [sys.executable, *program, *map(str, words)]
    return subprocess.Popen(words, **usual | options)


def succeed(*words, cwd=ROOT):
    """Run a command, check that it succeeds, and return what it prints."""
    done = command(*words, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_printable(done):
    """Check that a command printed no control characters."""
    assert all(line.isprintable() for line in (done.stdout + done.stderr).splitlines())


def with_json(*words):
    """Run a command with the option --json; return its output and the content of the file."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "results.json"
        return succeed(*words, "--json", file), json_in(file)


def assert_one_clear_line(done, message):
    """Check that a command ended with code 2 and one line of output that matches the message."""
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert re.search(message, line), line


def assert_refused(message, *words, **options):
    """Run a command; check that it ends with one line of output that matches a message."""
    assert_one_clear_line(command(*words, **options), message)
