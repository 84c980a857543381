"""mmwave-loc completion: commands and options completed by the shell."""

import argparse
import importlib
import os
from pathlib import Path

from experiments.arguments.completion import Args
from experiments.cli.main import commands, run
from experiments.cli.parser import METAVARS, parser_of
from experiments.evaluation.terminal import say
from mmwave_env.files import require_writable, write_text
from mmwave_env.lookup import choose, require_extra

FILES = {  # below the home of the user, where shells look
    "bash": ".local/share/bash-completion/completions/mmwave-loc",
    "zsh": ".zfunc/_mmwave-loc",
}
HINTS = {
    "bash": "bash-completion reads it in every new shell",
    "zsh": "new shells read it, if .zshrc says: fpath+=~/.zfunc; autoload -Uz compinit; compinit",
}


def program() -> argparse.ArgumentParser:
    """One parser of all commands, as :mod:`shtab` wants it."""
    import shtab

    whole = argparse.ArgumentParser("mmwave-loc")
    each = whole.add_subparsers()
    for name, (module, what) in commands().items():
        folder, _, page = module.rpartition(".")
        arguments = importlib.import_module(f"{folder}.arguments.{page}").Args
        options = parser_of(arguments, f"mmwave-loc {name}")
        each.add_parser(name, help=what, parents=[options], add_help=False)
        for action in options._actions:
            metavar = str(action.metavar)
            if metavar == METAVARS[Path]:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
            elif "|" in metavar:
                action.choices = metavar.split("|")
    return whole


def main(args: Args) -> None:
    """Run the command."""
    require_extra("shtab", "completion", "completion")
    import shtab

    shell = args.shell or Path(os.environ.get("SHELL", "")).name
    file = choose(FILES, shell, "shell")
    path = args.out or Path.home() / file
    require_writable(path)
    write_text(path, shtab.complete(program(), shell))
    say(f"written to {path}" + ("" if args.out else f"; {HINTS[shell]}"))


if __name__ == "__main__":
    run("completion")
