"""Program that writes the golden traces (``make golden``); ``--check`` only shows differences.

The last bits of results depend on the processor, because compilers and libraries choose
instructions for it. Tests therefore allow differences of 1e-9 (1e-5 in observations, which have
single precision). Differences are relative for numbers above 1, else absolute. Integers and words
must agree. ``--check`` compares text, to see on one machine whether a refactoring changes any bit.
"""

import math
import sys
from pathlib import Path

import numpy as np

from tests.golden.traces import TRACES

FOLDER = Path(__file__).parent
HEADER = "# Written by `make golden` (tests/golden/write.py).\n"
SHOWN = 5  # maximum number of differences printed per file


def text_of(rows):
    """Return rows as CSV: numbers can be restored exactly, and missing cells are empty."""
    rows = list(rows)
    columns = list(dict.fromkeys(name for row in rows[::-1] for name in row))
    lines = [columns, *([_word(row.get(name, "")) for name in columns] for row in rows)]
    return HEADER + "".join(";".join(line) + "\n" for line in lines)


def _word(value):
    if isinstance(value, np.ndarray):  # array of flags
        return "".join("FT"[int(flag)] for flag in value)
    return repr(float(value)) if isinstance(value, np.float64) else str(value)


def differences(name, old, new):
    """Return a line for each cell in which two texts of a trace differ by more than rounding."""
    before = [line.split(";") for line in old.splitlines()[1:]]
    after = [line.split(";") for line in new.splitlines()[1:]]
    if before[:1] != after[:1] or [row[0] for row in before] != [row[0] for row in after]:
        return [f"{name}: rows or columns differ"]
    return [
        f"{name}: row {row[0]!r}, column {column!r}: {a} became {b}"
        for row, changed in zip(before, after, strict=True)
        for column, a, b in zip(before[0], row, changed, strict=True)
        if not _same(a, b, 1e-5 if column.startswith("observation") else 1e-9)
    ]


def _same(a, b, tolerance):
    try:
        number = float(a)
        other = float(b)
    except ValueError:  # words, not numbers
        return a == b
    whole = a.lstrip("-").isdigit()
    return a == b or (
        not whole and math.isclose(number, other, rel_tol=tolerance, abs_tol=tolerance)
    )


def main(check):
    """Write traces that differ by more than rounding; with ``check``, fail if any bit differs."""
    differ = 0
    for name, trace in TRACES.items():
        path = FOLDER / f"{name}.csv"
        text = text_of(trace())
        old = path.read_text("utf-8") if path.exists() else HEADER
        print(f"{name}: {'same' if text == old else 'differs'}")
        if text != old:
            differ += 1
            changed = differences(name, old, text)
            print(*changed[:SHOWN], sep="\n")
            if changed and not check:
                path.write_text(text, "utf-8", newline="\n")
    if check and differ:
        sys.exit(f"{differ} traces differ. If this is intended, run `make golden` and explain why.")


if __name__ == "__main__":
    main("--check" in sys.argv[1:])
