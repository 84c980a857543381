"""Golden traces compared: exact on one kind of machine, to a tolerance on any other.

Compilers and libraries choose instructions by the processor, and so the last bits of what comes
out. On a machine of the kind that wrote the files nothing may differ, not in the last digit. On
others numbers may differ by 1e-9, observations (single precision) by 1e-5, both of the number or
of 1 where that is more; words may not.
"""

import math
import platform

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
import scipy

from tests.golden.text import GENERATOR, cells

TOLERANCE, OBSERVATION_TOLERANCE = 1e-9, 1e-5
SHOWN = 5  # differences in a message
ADVICE = "If this is meant, `make golden` writes the files anew; say why in the commit."


def machine() -> str:
    """The kind of machine, as ``machine.txt`` holds it: all that may decide the last bits."""
    config = numba.config  # which may say that other instructions are to be used
    features = config.CPU_FEATURES or llvm.get_host_cpu_features().flatten()
    vector = [f[1:] for f in features.split(",") if f.startswith(("+avx", "+fma", "+neon", "+sve"))]
    kind = {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": config.CPU_NAME or llvm.get_host_cpu_name(),
        "instructions": " ".join(vector) or "none",
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
    }
    lines = [f"# {GENERATOR} Machines of this kind compute what is written here to the last bit."]
    return "\n".join([*lines, *(f"{key} {value}" for key, value in kind.items())]) + "\n"


def differences(name: str, old: str, new: str, exact: bool) -> list[str]:
    """Where two versions of a file differ, one line a cell; none where they are the same.

    Args:
        name: of the file.
        old, new: what it holds.
        exact: to the last digit and byte, or to the tolerance.
    """
    if old == new:
        return []
    before, after = cells(name, old), cells(name, new)
    found = []
    for row, column in before | after:
        a, b = (side.get((row, column), "nothing") for side in (before, after))
        if a != b and (exact or not _close(column, a, b)):
            found.append(f"row {row!r}, column {column!r}: {a} became {b}")
    if not found and (exact or list(before) != list(after)):
        found.append("a comment, or the order of rows or columns")
    return found


def _close(column: str, a: str, b: str) -> bool:
    """Whether two cells hold the same to the tolerance."""
    tolerance = OBSERVATION_TOLERANCE if column.startswith("observation") else TOLERANCE
    if a[:1] == b[:1] == "~":  # hidden by a mask
        a, b = a[1:], b[1:]
    try:
        return math.isclose(float(a), float(b), rel_tol=tolerance, abs_tol=tolerance)
    except ValueError:  # a word
        return False


def message(name: str, found: list[str]) -> str:
    """What to tell of the differences of a file: how many, and a few of them."""
    more = [f"... and {len(found) - SHOWN} more"] if len(found) > SHOWN else []
    return "\n  ".join([f"{name}: {len(found)} differences", *found[:SHOWN], *more])
