"""The command line ``mmwave-loc <command>``."""

import importlib
import importlib.util
import os
import sys
import warnings
from collections.abc import Sequence
from typing import Any, NoReturn

import tyro

from mmwave_env.files import require_writable

COMMANDS = {
    "localize": "the track of a measurement log, by the paper's pipelines (Algorithm 1)",
    "evaluate": "one policy, its metrics with intervals",
    "compare": "several policies on the same episodes, with paired differences",
    "tables": "the paper's tables and claims, reproduced",
    "train": "switchers that learn, on several training seeds",
    "transfer": "switchers on streets, radios and recordings they were not trained on",
    "tune": "process noise of modes, by likelihood or error, on tuning seeds",
    "tune-imm": "the best transition and process noise of IMMs, on tuning seeds",
    "benchmark": "steps per second beside filterpy's and the core's limit, memory, first step",
    "simulate": "one episode as files: measurement log, scene and truth",
    "demo": "the tables of docs/results.md, on simulated and ray-traced streets",
}
STUDIES = {  # of a checkout: the installed package goes without them
    "ablate": ("experiments.learning.ablate", "trainings with one thing changed at a time"),
    "learned": (
        "experiments.learning.learned",
        "the tables and figures of docs/learning.md, from recorded runs",
    ),
    "soak": (
        "experiments.reliability.soak",
        "many steps of all modes on damaged data, every number checked",
    ),
}


def commands() -> dict[str, tuple[str, str]]:
    """Module and meaning of every command there is."""
    found = {
        name: (f"experiments.{name.replace('-', '_')}", what) for name, what in COMMANDS.items()
    }
    return found | {n: study for n, study in STUDIES.items() if _is_there(study[0])}


def _is_there(module: str) -> bool:
    package, _, _ = module.rpartition(".")
    return importlib.util.find_spec(package) is not None


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"warning: {message}", file=sys.stderr)


def _leave(code: int) -> NoReturn:
    """Exit, without a complaint of Python's where nobody reads what is left to write."""
    try:
        print(end="", flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


def run(name: str, arguments: Sequence[str] | None = None) -> None:
    """Run one command; bad input ends with one line and exit code 2.

    Args:
        name: of the command.
        arguments: its options; None for those the program was started with.
    """
    warnings.showwarning = _show_warning
    command = importlib.import_module(commands()[name][0])
    args = tyro.cli(command.Args, args=arguments, prog=f"mmwave-loc {name}")
    try:
        json = getattr(args, "json", None)  # not every command has figures to write
        if json is not None:
            require_writable(json)
        command.main(args)
        print(end="", flush=True)
    except BrokenPipeError:  # the reader has seen enough
        _leave(141)  # as a shell reports a program that SIGPIPE ended
    except (ValueError, OSError) as error:
        print(f"mmwave-loc {name}: {error}", file=sys.stderr)
        _leave(2)
    except KeyboardInterrupt:
        print(f"mmwave-loc {name}: interrupted", file=sys.stderr)
        sys.exit(130)


def main() -> None:
    """The program: the first argument names the command."""
    arguments, there = sys.argv[1:], commands()
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: mmwave-loc <command> [options]; --help after a command lists its options\n")
        for name, (_, what) in there.items():
            print(f"  {name:16} {what}")
        sys.exit(0 if arguments else 2)
    if arguments[0] not in there:
        known = ", ".join(there)
        print(f"command: found {arguments[0]!r}, expected one of {known}", file=sys.stderr)
        sys.exit(2)
    run(arguments[0], arguments[1:])
