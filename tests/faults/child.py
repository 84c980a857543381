"""A command in a process of its own, which can be ended at any moment.

Most are forked from a process that has imported everything, and so are the processes that they
start: a run takes a second where a fresh one takes ten. What is at issue, the files, begins after
the imports; some runs are fresh ones nevertheless, as typed.
"""

import multiprocessing
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

from experiments.console.main import main
from tests.cli import environment

LONGEST_S = 120.0  # that a command, or what it leaves running, may take to end
FORK = multiprocessing.get_context("fork")


class Child:
    """A running command.

    Args:
        words: behind ``mmwave-loc``.
        folder: where it is run; temporary files go there, too.
        fresh: in a new interpreter.
        prepare: called in it at first.
        variables: of its environment.

    Attributes:
        words, folder: as given.
    """

    def __init__(
        self,
        words: tuple[str, ...],
        folder: Path,
        *,
        fresh: bool = False,
        prepare: Callable[[], object] = lambda: None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self.words, self.folder = words, folder
        self._told, ends = os.pipe()
        given = (words, folder, fresh, prepare, variables or {}, ends)
        self._process = FORK.Process(target=_run, args=given)
        self._begun_s = time.monotonic()
        self._process.start()
        os.close(ends)
        os.read(self._told, 1)  # it begins

    @property
    def group(self) -> int:
        """The number of its process group, and of the command's own process."""
        assert self._process.pid is not None
        return self._process.pid

    def send(self, number: int, *, to_all: bool) -> None:
        """Send a signal to the command, or to all of its group, as terminals do."""
        with suppress(ProcessLookupError):  # it was quicker
            (os.killpg if to_all else os.kill)(self.group, number)

    def ended(self) -> tuple[int, str, float]:
        """Exit code, minus the signal if one ended it; what it printed; seconds.

        Raises:
            TimeoutError: it does not end, or something that it started does not.
        """
        self._process.join(LONGEST_S)
        code, seconds = self._process.exitcode, time.monotonic() - self._begun_s
        gone = any(not _there(self.group) or time.sleep(0.01) for _ in range(int(LONGEST_S * 100)))
        if code is None or not gone:
            self.send(signal.SIGKILL, to_all=True)
            self._process.join()
        with os.fdopen(self._told, encoding="utf-8", errors="replace") as file:
            told = file.read()
        if code is None or not gone:
            raise TimeoutError(f"found processes that do not end: {told[-500:]}")
        return code, told, seconds


def _there(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def _run(
    words: tuple[str, ...],
    folder: Path,
    fresh: bool,
    prepare: Callable[[], object],
    variables: Mapping[str, str],
    told: int,
) -> None:
    os.setsid()
    # What a shell runs in the background ignores Ctrl-C, and so does all that it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    os.chdir(folder)
    os.environ |= environment() | {"TMPDIR": str(folder)} | variables
    for stream in (1, 2):
        os.dup2(told, stream)
    prepare()
    os.write(told, b"\n")
    if fresh:
        os.execv(sys.executable, [sys.executable, "-m", "experiments.console", *words])
    sys.stdout, sys.stderr = (os.fdopen(stream, "w", closefd=False) for stream in (1, 2))
    sys.argv = ["mmwave-loc", *words]
    warnings.resetwarnings()
    warnings.simplefilter("ignore")
    warnings.simplefilter("default", UserWarning)
    multiprocessing.get_context = lambda method=None: FORK
    code = 0
    try:
        main()
    except SystemExit as end:
        code = int(end.code or 0)
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):
            stream.flush()
    os._exit(code)  # what else the fork would do at its end is not the command's
