"""The command line ``mmwave-loc <command>``."""

import importlib
import sys
import warnings
from typing import Any

import tyro

COMMANDS = {
    "evaluate": "one policy, its metrics with intervals",
    "compare": "several policies on the same episodes, with paired differences",
    "tune-threshold": "the best threshold of the speed rule, on tuning seeds",
    "benchmark": "steps per second beside filterpy's, as ratios",
    "demo": "the comparison of the README, on simulated and ray-traced streets",
}


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    print(f"warning: {message}", file=sys.stderr)


def main() -> None:
    """Run a command; bad input ends with one line and exit code 2."""
    warnings.showwarning = _show_warning
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print("usage: mmwave-loc <command> [options]; --help after a command lists its options\n")
        for name, what in COMMANDS.items():
            print(f"  {name:16} {what}")
        sys.exit(0 if arguments else 2)
    name = arguments[0]
    if name not in COMMANDS:
        print(f"command: found {name!r}, expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    command = importlib.import_module(f"experiments.{name.replace('-', '_')}")
    args = tyro.cli(command.Args, args=arguments[1:], prog=f"mmwave-loc {name}")
    try:
        command.main(args)
    except (ValueError, OSError) as error:
        print(f"mmwave-loc {name}: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
