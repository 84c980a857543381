"""``python -m tests.faults.fuzz``: every reader with many damaged files, guided by coverage."""

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import atheris

# Lines of these guide it; filters and engines have no file to read.
ROOMS = [
    "mmwave_env.files", "mmwave_env.records", "mmwave_env.lookup", "mmwave_env.logs",
    "mmwave_env.models.scene", "mmwave_env.models.radio", "mmwave_env.episodes.deepmimo",
    "mmwave_env.episodes.mobility", "mmwave_env.episodes.trajectory", "mmwave_env.episodes.ways",
    "mmwave_env.filters.bank", "mmwave_env.filters.mode_files",
    "policies.policy_file", "experiments.webpage", "experiments.sweeping",
    "experiments.evaluation.runs", "experiments.training.hyperparameters",
    "experiments.training.checkpoint",
]  # fmt: skip
with atheris.instrument_imports(include=ROOMS):
    from tests.faults.fuzz.engine import fuzz
    from tests.faults.fuzz.outcomes import ACCEPTED, FAULTS, OUTCOMES, TRACEBACK
    from tests.faults.fuzz.readers import READERS, Reader


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.faults.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, default=2000, help="a reader")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--readers", nargs="+", choices=[one.name for one in READERS])
    parser.add_argument("--keep", type=Path, help="folder for the contents that went wrong")
    args = parser.parse_args()
    chosen = [one for one in READERS if not args.readers or one.name in args.readers]
    begin, found = time.monotonic(), {}
    for reader in chosen:
        found[reader.name] = _in_a_process(reader, args.cases, args.seed)
        for i, (fault, where, content) in enumerate(found[reader.name]["examples"]):
            print(f"{reader.name}: {fault}: {where}", file=sys.stderr, flush=True)
            if args.keep:
                args.keep.mkdir(parents=True, exist_ok=True)
                name = f"{reader.name}-{i}".replace(" ", "_")
                (args.keep / name).write_bytes(bytes.fromhex(content)[1:])
    print(_table(found))
    print(f"\n{args.cases} cases a reader, seed {args.seed}, {time.monotonic() - begin:.0f} s")
    faults = sum(one["counts"].get(fault, 0) for one in found.values() for fault in FAULTS)
    unread = [name for name, one in found.items() if not one["counts"].get(ACCEPTED)]
    if unread:
        print(f"nothing accepted by {', '.join(unread)}", file=sys.stderr)
    sys.exit(1 if faults or unread else 0)


def _in_a_process(reader: Reader, cases: int, seed: int) -> Mapping[str, Any]:
    """Counts and examples of a reader: libFuzzer never returns, so it gets a process."""
    with TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        child = os.fork()
        if not child:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            silence = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silence, 1)
            try:
                fuzz(reader, cases, seed, report)
            finally:  # where it fails itself
                os._exit(1)
        _, status = os.waitpid(child, 0)
        text = report.read_text() if report.is_file() else '{"counts": {}, "examples": []}'
        found: dict[str, Any] = json.loads(text)
        if status:
            found["counts"][TRACEBACK] = found["counts"].get(TRACEBACK, 0) + 1
            found["examples"].append([TRACEBACK, f"the process ended with status {status}", ""])
        return found


def _table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """Counts, as Markdown."""
    rows = []
    for name, one in found.items():
        counts = [one["counts"].get(outcome, 0) for outcome in OUTCOMES]
        rows.append([name, sum(counts[:-1]), *counts])  # memory is counted beside the outcome
    total = ["all", *(sum(row[i] for row in rows) for i in range(1, len(OUTCOMES) + 2))]
    lines = [["reader", "cases", *OUTCOMES], ["---"] * (len(OUTCOMES) + 2), *rows, total]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


if __name__ == "__main__":
    main()
