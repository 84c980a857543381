"""The command line ``mmwave-loc <command>``.

A command is a page, which does the work, and its options in the folder ``arguments`` beside it.
Options are read first, and little is imported until they are: help and mistakes are shown at once.
"""

import importlib
import os
import shutil
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from io import TextIOWrapper
from typing import Any, NoReturn

from experiments.cli.entries import entries
from experiments.evaluation.signals import Ended, ended_by_signals, stopped_at_once

COMMANDS = {
    "localize": "the track of a measurement log, by the paper's pipelines (Algorithm 1)",
    "evaluate": "one policy, its metrics with intervals",
    "compare": "several policies on the same episodes, with paired differences",
    "tables": "the paper's tables and claims, reproduced",
    "train": "switchers that learn, on several training seeds",
    "convert": "a model of Stable-Baselines3 as a policy file, which holds no code",
    "transfer": "switchers on streets, radios and recordings they were not trained on",
    "leaderboard": "the benchmark of docs/benchmark.md: entries judged alike, and ranked",
    "sweep": "grids of evaluations and trainings, cell by cell, here or on a Ray cluster",
    "tune": "process noise of modes, by likelihood or error, on tuning seeds",
    "tune-imm": "the best transition and process noise of IMMs, on tuning seeds",
    "benchmark": "steps per second beside filterpy's and the core's limit, memory, first step",
    "watch": "an episode as policies go through it, side by side, in a window or as a video",
    "collect": "what policies see, choose and earn, as a Minari data set to learn from",
    "simulate": "one episode as files: measurement log, scene and truth",
    "doctor": "versions, compiled functions on disk, a self-test of every kernel, extras",
    "samples": "the logs and recordings that come with the package: listed, copied, or compared on",
    "list": "policies, scenarios, radios, scenes, modes, samples and rewards by name",
    "completion": "completes commands and options in your shell: writes what it needs",
    "report": "one self-contained web page of results: compare, train, localize, transfer",
    "demo": "the tables of docs/results.md, on simulated and ray-traced streets",
}
LONGEST_LINE = 2000  # letters of a message


def commands() -> dict[str, tuple[str, str]]:
    """Module and meaning of every command there is."""
    return {
        name: (f"experiments.{name.replace('-', '_')}", what) for name, what in COMMANDS.items()
    }


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"warning: {_in_one_line(str(message))}", file=sys.stderr)


def _in_one_line(text: str) -> str:
    """A message with nothing in it but letters, cut where it quotes much of a file."""
    from mmwave_env.lookup import printable

    line = printable(text)
    return line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]} ..."


def _leave(code: int) -> NoReturn:
    """Exit, without a complaint of Python's where nobody reads what is left to write."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def read_arguments(module: str, words: Sequence[str], program: str) -> Any:
    """What was typed, as the dataclass of the options of a command's page.

    Raises:
        SystemExit: help was asked for, or an option is wrong.
    """
    from experiments.cli.parser import parse

    folder, _, name = module.rpartition(".")
    return parse(importlib.import_module(f"{folder}.arguments.{name}").Args, words, program)


@contextmanager
def _quiet() -> Iterator[None]:
    """Neither bars nor anything printed, but for warnings and errors."""
    from experiments.evaluation.terminal import QUIET

    token = QUIET.set(True)
    try:
        with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
            yield
    finally:
        QUIET.reset(token)


def _complain(program: str, error: BaseException, debug: bool) -> None:
    """Say in one line what went wrong; and where, if that is asked for."""
    if debug:
        traceback.print_exception(error)
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        line = f"what is printed: {error.strerror}"  # of files, errors name the file
    elif isinstance(error, (ValueError, OSError)):
        line = str(error)
    else:
        where = "" if debug else "; --debug shows where, please report it"
        line = f"failed with {type(error).__name__}: {error}{where}"
    print(f"{program}: {_in_one_line(line)}", file=sys.stderr)


def run(name: str, words: Sequence[str] | None = None) -> None:
    """Run one command; bad input ends with one line and exit code 2, a fault of ours with 1.

    Args:
        name: of the command.
        words: its options; None for those the program was started with.
    """
    program, words = f"mmwave-loc {name}", sys.argv[1:] if words is None else words
    debug = "--debug" in words
    try:
        with stopped_at_once():
            warnings.showwarning = _show_warning
            for stream in (sys.stdout, sys.stderr):
                if isinstance(stream, TextIOWrapper):  # which may not have all letters of names
                    stream.reconfigure(errors="backslashreplace")
            module, _ = commands()[name]
            args = read_arguments(module, words, program)
            command = importlib.import_module(module)
        with ended_by_signals(), _quiet() if "--quiet" in words else nullcontext():
            _require_results_can_be_written(args)
            command.main(args)
        print(end="", flush=True)
    except BrokenPipeError:  # the reader has seen enough
        _leave(141)  # as a shell reports a program that SIGPIPE ended
    except (ValueError, OSError) as error:
        _complain(program, error, debug)
        _leave(2)
    except Exception as error:
        _complain(program, error, debug)
        _leave(1)
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        sys.exit(130)
    except Ended as end:
        with suppress(OSError):  # the terminal may be gone
            print(f"{program}: {end.told}", file=sys.stderr)
        _leave(int(str(end.code)))


def _require_results_can_be_written(args: Any) -> None:
    from mmwave_env.files import require_writable

    for name in ("json", "episodes_csv"):
        path = getattr(args, name, None)  # not every command has figures to write
        if path is not None:
            require_writable(path)


def main() -> None:
    """The program: the first argument names the command."""
    with stopped_at_once():
        words, there = sys.argv[1:], commands()
    if not words or words[0] in ("-h", "--help"):
        print("usage: mmwave-loc <command> [options]; --help after a command lists its options\n")
        whats = {name: what for name, (_, what) in there.items()}
        print(*entries(whats, 16, min(79, shutil.get_terminal_size().columns)), sep="\n")
        sys.exit(0 if words else 2)
    if words[0] in there:
        run(words[0], words[1:])
        return
    with stopped_at_once():
        from mmwave_env import __version__
        from mmwave_env.lookup import unknown
    if words[0] in ("-V", "--version"):
        print(f"mmwave-loc {__version__}")
        return
    print(_in_one_line(unknown("command", words[0], there)), file=sys.stderr)
    sys.exit(2)
