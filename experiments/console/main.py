"""The command line ``mmwave-loc <command>``.

A command is a page of this package, with its options on top. Little is imported before these are
read: help and mistakes are shown at once.
"""

import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from io import TextIOWrapper
from typing import Any, NoReturn

from experiments.console import removed
from experiments.console.signals import Ended, ended_by_signals, stopped_at_once

GROUPS = {
    "begin": {
        "demo": "every policy, on simulated and ray-traced streets",
        "list": "what has a name: policies, kinds of users, radios, streets, ...",
    },
    "localize": {
        "localize": "the track of a measurement log (the paper's Algorithm 1, IMM)",
        "simulate": "one episode as files: measurement log, scene and truth",
    },
    "compare": {
        "compare": "policies on the same episodes, with paired differences",
        "evaluate": "another word for compare",
        "tables": "the paper's tables and claims, reproduced",
        "leaderboard": "entries of the benchmark, judged alike and ranked",
        "watch": "an episode as policies go through it: a window or a video",
        "report": "one self-contained web page of results",
    },
    "train": {
        "train": "switchers that learn, on several training seeds",
        "tune": "process noise of modes, by likelihood or error, on tuning seeds",
        "sweep": "grids of comparisons and trainings, here or on a Ray cluster",
        "convert": "a model of Stable-Baselines3 as a file without code",
    },
    "measure": {
        "speed": "steps per second beside filterpy's and the core's limit",
    },
}
COMMANDS = {name: what for group in GROUPS.values() for name, what in group.items()}
SAME = {"evaluate": "compare"}  # other words for commands
SHELLS = ("bash", "zsh", "fish")  # that tyro completes commands and options in
LONGEST_LINE = 2000  # letters of a message


def page_of(name: str) -> str:
    """The module of a command."""
    return f"experiments.{SAME.get(name, name)}"


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


def read_arguments(name: str, words: Sequence[str]) -> Any:
    """What was typed, as the dataclass of the options of a command's page.

    Raises:
        SystemExit: help was asked for, or an option is wrong.
    """
    from experiments.console.parser import parse

    return parse(importlib.import_module(page_of(name)).Args, words, f"mmwave-loc {name}")


@contextmanager
def _quiet() -> Iterator[None]:
    """Neither bars nor anything printed, but for warnings and errors."""
    from experiments.console.progress import QUIET

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
        # Of files, errors name the file.
        missing = isinstance(error, FileNotFoundError)
        line = f"{'the working folder' if missing else 'what is printed'}: {error.strerror}"
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
            args, command = read_arguments(name, words), importlib.import_module(page_of(name))
            importlib.import_module("experiments.evaluation.asked")  # what all commands wait for
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
    for name, ending in {"json": ".json", "episodes_csv": ".csv"}.items():
        path = getattr(args, name, None)  # not every command has figures to write
        if path is None:
            continue
        if path.suffix != ending:
            option = name.replace("_", "-")
            raise ValueError(f"{option}: found {path}, expected a name that ends with {ending}")
        from mmwave_env.files import require_writable

        require_writable(path)


def _help() -> str:
    """The commands in groups, folded where a terminal ends."""
    lines = [
        "usage: mmwave-loc COMMAND [OPTIONS]; --help after a command lists its options",
        "       mmwave-loc --version; --json after it also tests the compiled kernels",
    ]
    for group, commands in GROUPS.items():
        lines += ["", f"{group}:"]
        for name, what in commands.items():
            lines.append(f"  {name:12} {what}")
    return "\n".join(lines)


def _tell_about() -> NoReturn:
    """Print versions, threads, where kernels are kept and their self-test; exit 1 where it fails.

    Raises:
        SystemExit: always.
    """
    import json

    from experiments.console.version import about

    told = about()
    print(json.dumps(told, indent=2))
    sys.exit(0 if all(test["passed"] for test in told["self_test"]) else 1)


def _complete(words: Sequence[str]) -> None:
    """Print or write what a shell needs to complete commands and options.

    Raises:
        SystemExit: always.
    """
    if len(words) < 2 or words[1] not in SHELLS:
        print(f"mmwave-loc: {words[0]}: expected one of {', '.join(SHELLS)}", file=sys.stderr)
        sys.exit(2)
    import tyro

    from experiments.console.parser import described

    commands: dict[str, Callable[..., Any]] = {
        name: described(importlib.import_module(page_of(name)).Args) for name in COMMANDS
    }
    tyro.extras.subcommand_cli_from_dict(commands, prog="mmwave-loc", args=words)


def main() -> None:
    """The program: the first argument names the command."""
    words = sys.argv[1:]
    if not os.environ.get("COLUMNS", "80").strip("0"):  # some terminals do not know their width
        del os.environ["COLUMNS"]
    if words[:1] == ["help"]:  # as --help, of the program or of a command
        words = [*words[1:], "--help"]
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        sys.exit(0 if words else 2)
    if words[0] in COMMANDS:
        run(words[0], words[1:])
        return
    with stopped_at_once():
        if words[0].startswith("--tyro-"):
            _complete(words)
        from mmwave_env import __version__
        from mmwave_env.lookup import unknown
    if words[0] in ("-V", "--version"):
        if words[1:] == ["--json"]:
            _tell_about()
        print(f"mmwave-loc {__version__}")
        return
    gone = removed.COMMANDS.get(words[0])
    message = f"{words[0]} is gone: {gone}" if gone else unknown("command", words[0], COMMANDS)
    print(f"mmwave-loc: {_in_one_line(message)}", file=sys.stderr)
    sys.exit(2)
