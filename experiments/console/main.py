"""The command line ``mmwave-loc <command>``.

A command is a module in ``experiments`` with a class ``Args``, which declares its options, and a
function ``main``. Options are read before slow imports, so help and errors appear immediately.
"""

import importlib
import itertools
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NoReturn

from experiments.console.signals import heed_signals

COMMANDS = {
    "demo": "compare all policies on simulated and ray-traced streets",
    "localize": "compute the track of a measurement log, or find its errors",
    "simulate": "write one episode as files: measurement log, scene and truth",
    "compare": "compare policies on the same episodes, with paired differences",
    "tables": "reproduce the paper's tables and test its claims",
    "leaderboard": "judge contenders by the benchmark, and rank all entries",
    "watch": "play an episode with some policies, in a window or as a video",
    "report": "make one self-contained web page of results",
    "train": "train policies, with several training seeds; resume trainings",
    "tune": "tune the process noise of modes, or whole banks",
    "sweep": "run grids of comparisons and trainings, here or on a Ray cluster",
    "speed": "measure steps per second and latency",
}
RESULTS = {  # option -> ending of its file
    "json": ".json",
    "episodes-csv": ".csv",
    "map-out": ".json",
    "write": ".json",
}
# options that name files to be written
WRITTEN = (*RESULTS, "out", "errors", "consistency")
EVERYWHERE = {  # options of every command
    "--quiet": "show neither tables nor progress, only warnings and errors",
    "--debug": "if something fails, show where in the program (a traceback)",
}


def _leave(code: int) -> NoReturn:
    """Exit; print no traceback if the reader of the output has closed it."""
    try:
        print(end="", flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def read_arguments(name: str, words: Sequence[str]) -> Any:
    """Parse words of a command line into the ``Args`` of a command's module.

    Raises:
        ValueError, SystemExit: same as for :func:`~experiments.console.options.parsed`.
    """
    from experiments.console.options import parsed  # slow: it imports tyro

    return parsed(importlib.import_module(f"experiments.{name}").Args, name, words)


def _print_problem(text: str) -> None:
    """Print one line on standard error, in printable characters."""
    from mmwave_env.io.lookup import printable

    print(printable(text), file=sys.stderr)


def _complain(program: str, error: BaseException, debug: bool) -> None:
    """Print one line about an error, after its traceback if ``debug``."""
    if debug:
        traceback.print_exception(error)
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        # An OSError without a file's name is about standard output or the working folder.
        missing = isinstance(error, FileNotFoundError)
        line = f"{'the working folder' if missing else 'standard output'}: {error.strerror}"
    elif isinstance(error, (ValueError, OSError)):
        line = str(error)
    else:
        where = "" if debug else "; please report it (--debug shows where it happened)"
        line = f"failed with {type(error).__name__}: {error}{where}"
    _print_problem(f"{program}: {line}")


@contextmanager
def _errors_in_one_line(program: str, debug: bool = False) -> Iterator[None]:
    """Exit after an error in the block: with 2 after bad input, with 1 after an internal error.

    After a signal, exit with 128 plus its number.
    """
    try:
        heed_signals()
        yield
        print(end="", flush=True)
    except BrokenPipeError:  # the reader closed the pipe
        _leave(141)  # the code that shells give to a program ended by SIGPIPE
    except Exception as error:
        _complain(program, error, debug)
        _leave(2 if isinstance(error, (ValueError, OSError)) else 1)
    except KeyboardInterrupt as end:  # after Ctrl-C, it has no argument
        number = signal.Signals(*(end.args or [signal.SIGINT]))
        message = f"ended by {number.name}" if end.args else "interrupted"
        with suppress(OSError):  # the terminal may be gone
            print(f"{program}: {message}", file=sys.stderr)
        _leave(128 + number)


def _require_own_files(args: Any) -> None:
    """Refuse a file of results that another option names, too.

    Raises:
        ValueError: there is one.
    """
    named = [
        (option.replace("_", "-"), Path(word))
        for option, value in vars(args).items()
        for word in (value if isinstance(value, tuple) else (value,))
        if isinstance(word, str | Path)
    ]
    for (option, path), (other, read) in itertools.permutations(named, 2):
        if option in WRITTEN and option != other and path.resolve() == read.resolve():
            raise ValueError(f"{option}: found {path}, expected another file than for {other}")


def run(name: str, words: Sequence[str]) -> None:
    """Run one command; exit with 2 after bad input, and with 1 after an internal error."""
    debug = "--debug" in words
    quiet = "--quiet" in words
    words = [word for word in words if word not in EVERYWHERE]
    with _errors_in_one_line(f"mmwave-loc {name}", debug):
        warnings.showwarning = lambda message, *_, **__: _print_problem(f"warning: {message}")
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):  # its encoding may lack a character
                stream.reconfigure(errors="backslashreplace")
        args = read_arguments(name, words)
        from experiments.console.output import QUIET

        QUIET.set(quiet)
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere if quiet else sys.stdout):
            _require_own_files(args)
            for option, ending in RESULTS.items():
                path = getattr(args, option.replace("-", "_"), None)  # not every command has it
                if path is None:
                    continue
                if path.suffix != ending:
                    raise ValueError(
                        f"{option}: found {path}, expected a name that ends with {ending}"
                    )
                from mmwave_env.io.files import require_writable

                require_writable(path)
            importlib.import_module(f"experiments.{name}").main(args)


def _help() -> str:
    """Return the list of commands, and of the options that all of them have."""
    lines = [
        "usage: mmwave-loc COMMAND [OPTIONS]; --help after a command lists its options",
        "       mmwave-loc --version; --json after it adds the versions of other packages",
    ]
    for listed in (COMMANDS, EVERYWHERE):
        lines += ["", *(f"  {name:12} {about}" for name, about in listed.items())]
    return "\n".join(lines)


def main() -> None:
    """Run the program: the first argument names the command."""
    words = sys.argv[1:]
    for stream, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, stream) is None:  # closed by a shell, as by <&-
            setattr(sys, stream, open(os.devnull, mode))  # noqa: SIM115
    if not os.environ.get("COLUMNS", "80").strip("0"):  # some terminals claim a width of 0
        del os.environ["COLUMNS"]
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        sys.exit(0 if words else 2)
    if words[0] in COMMANDS:
        run(words[0], words[1:])
        return
    with _errors_in_one_line("mmwave-loc"):
        if words[0].startswith("--tyro-"):  # prints or writes a shell's completion script, exits
            import tyro

            options = {n: importlib.import_module(f"experiments.{n}").Args for n in COMMANDS}
            tyro.extras.subcommand_cli_from_dict(options, prog="mmwave-loc", args=words)
        from mmwave_env import __version__
        from mmwave_env.io.lookup import unknown

        if words[0] != "--version":
            raise ValueError(unknown("command", words[0], COMMANDS))
        if words[1:] != ["--json"]:
            print(f"mmwave-loc {__version__}")
            return
        import json

        from experiments.console.provenance import versions

        print(json.dumps(versions(), indent=2))
