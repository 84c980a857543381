"""mmwave-loc doctor: whether this machine computes what it should, and what is missing."""

import os
import platform
import sys
from collections.abc import Mapping
from itertools import groupby
from typing import Any

import numba

from experiments.arguments.doctor import Args
from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.terminal import progress
from experiments.evaluation.text import escaped
from experiments.health.installed import Package, packages
from experiments.health.self_test import TOLERANCE, Check, self_test
from mmwave_env import __version__
from mmwave_env.compiler.disk_cache import KeptFunctions, kept_functions
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.files import write_json


def machine() -> dict[str, str]:
    """What runs here, by what it is."""
    return {
        "mmwave-loc": __version__,
        "Python": f"{platform.python_version()}, {sys.executable}",
        "system": platform.platform(),
        "processor": f"{numba.config.CPU_NAME or _processor()}, {os.cpu_count()} threads; "
                     f"{WIDTH} environments at a time in each",
        "threads allowed": _affinity(),
    }  # fmt: skip


def _processor() -> str:
    from llvmlite.binding import get_host_cpu_name

    return str(get_host_cpu_name())


def _affinity() -> str:
    if not hasattr(os, "sched_getaffinity"):
        return "all"
    return str(len(os.sched_getaffinity(0)))


def _cache_rows(places: list[KeptFunctions]) -> list[list[str]]:
    return [
        [
            str(one.place),
            "in use" if one.used else "not in use",
            "-" if one.owner is None else str(one.owner),
            f"{one.mode:o}",
            str(one.versions),
            str(one.functions),
            f"{one.size / 2**20:.1f}",
            str(one.doubtful),
        ]
        for one in places
    ]


def _extras(found: list[Package]) -> Mapping[str, list[Package]]:
    by_extra = sorted(found, key=lambda package: package.extra)
    return {extra: list(of) for extra, of in groupby(by_extra, lambda package: package.extra)}


def _extra_rows(found: list[Package]) -> list[list[str]]:
    rows = []
    for extra, of in _extras(found).items():
        there = ", ".join(f"{one.name} {one.found}" for one in of if one.found)
        missing = ", ".join(one.wanted for one in of if not one.found)
        cure = f"pip install 'mmwave-loc[{extra}]'" if extra else "pip install mmwave-loc"
        rows.append([extra or "(base)", there or "-", missing or "-", cure if missing else "-"])
    return rows


def report(checks: list[Check], places: list[KeptFunctions], found: list[Package]) -> str:
    """All of it as Markdown."""
    lines = "".join(f"- {what}: {escaped(value)}\n" for what, value in machine().items())
    kept = "Compiled functions on disk:\n\n" + grid(
        ["place", "state", "owner", "mode", "versions", "functions", "MiB", "left alone"],
        _cache_rows(places),
    ) if any(one.used for one in places) else (
        "Compiled functions are not kept: no folder can be written that is ours alone; every "
        "process compiles anew"
    )  # fmt: skip
    rows = [
        [one.kernel, one.twin, f"{one.deviation:.0e}", "passed" if one.passed else "FAILED"]
        for one in checks
    ]
    tested = grid(["kernel", "beside", "largest deviation", "self-test"], rows)
    extras = (
        grid(["extra", "installed", "missing", "to install"], _extra_rows(found))
        if found
        else ("mmwave-loc is run from a folder and not installed, so nobody knows what it asks for")
    )
    passed = sum(one.passed for one in checks)
    verdict = f"{passed} of {len(checks)} kernels are what their twins are."
    return f"{lines}\n{kept}\n\n{tested}\n\n{extras}\n\n{verdict}\n"


def main(args: Args) -> None:
    """Run the command.

    Raises:
        RuntimeError: a kernel does not compute what its twin does.
    """
    found, checks = packages(), []
    there = {one.name for one in found if one.found}
    with progress("self-test") as told:
        for check in self_test(with_filterpy="filterpy" in there):
            checks.append(check)
            told(len(checks) / 7.0)
    places = kept_functions()
    if args.json:
        write_json(args.json, provenance("doctor", args) | _figures(checks, places, found))
    show(report(checks, places, found))
    failed = [one.kernel for one in checks if not one.passed]
    if failed:
        raise RuntimeError(
            f"{', '.join(failed)}: found other numbers than those of independent twins, expected "
            f"them within {TOLERANCE:g}; remove the compiled functions on disk and try again"
        )


def _figures(
    checks: list[Check], places: list[KeptFunctions], found: list[Package]
) -> dict[str, Any]:
    return {
        "machine": machine(),
        "self_test": [{**one._asdict(), "passed": one.passed} for one in checks],
        "compiled_functions": [
            {**one._asdict(), "place": str(one.place), "mode": f"{one.mode:04o}"} for one in places
        ],
        "packages": [one._asdict() for one in found],
    }


if __name__ == "__main__":
    run("doctor")
