"""Write the golden traces anew: ``make golden``; with ``--check`` only tell what would change."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tests.golden.comparison import ADVICE, differences, machine, message
from tests.golden.text import cells
from tests.golden.traces import KINDS, Files

FOLDER = Path(__file__).parent
MACHINE = "machine.txt"


def read(kind: str) -> Files:
    """The files of a kind, as they were written."""
    return {path.name: path.read_text("utf-8") for path in sorted(FOLDER.glob(f"{kind}.*"))}


def write(kind: str, files: Files) -> None:
    """Write the files of a kind; those that it has no more are removed."""
    for name in read(kind).keys() - files.keys():
        (FOLDER / name).unlink()
    for name, text in files.items():
        (FOLDER / name).write_text(text, "utf-8", newline="\n")


def same_machine() -> bool:
    """Whether this machine is of the kind that wrote the files, so that they hold exactly."""
    there = read("machine").get(MACHINE, "")
    return cells(MACHINE, there) == cells(MACHINE, machine())


def changes(old: Files, new: Files, exact: bool) -> list[str]:
    """What to tell of every file that differs, or that one side lacks."""
    told = []
    for name in sorted(old.keys() | new.keys()):
        if name not in old:
            told.append(f"{name}: is new")
        elif name not in new:
            told.append(f"{name}: nothing writes it any more")
        elif found := differences(name, old[name], new[name], exact):
            told.append(message(name, found))
    return told


def main(arguments: Sequence[str] | None = None) -> None:
    """Write all files, or compare them with ``--check``: then exit code 1 where they differ."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden.write", description=__doc__)
    parser.add_argument("--check", action="store_true", help="compare and write nothing")
    check = parser.parse_args(arguments).check
    exact, told = not check or same_machine(), []
    for kind, function in KINDS.items():
        begun, new = time.process_time(), function()
        took, size = time.process_time() - begun, sum(map(len, new.values()))
        print(f"{kind:18}{len(new):2} files{size / 1e3:7.1f} kB, {took:4.1f} s of processor time")
        told += changes(read(kind), new, exact)
        if not check:
            write(kind, new)
    if not check:
        write("machine", {MACHINE: machine()})
    how = "to the last digit" if exact else "to a tolerance: this is another kind of machine"
    print("\n".join([*told, f"{len(told)} files differ, compared {how}"]))
    if check and told:
        sys.exit(ADVICE)


if __name__ == "__main__":
    main()
