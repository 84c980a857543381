"""Commands ended at random moments and kept from writing; then: is every file whole?

``python -m tests.faults.campaign --runs 50 --seed 0`` disturbs each command 50 times in each way,
and prints the table of docs/reliability.md. A command that was disturbed is started again, a few
times over, until it ends by itself; its results must then be those of one that nobody disturbed.
"""

import argparse
import random
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from experiments.console.tables import grid
from tests.cli import succeed
from tests.faults.cases import CASES, Case, hidden
from tests.faults.child import Child
from tests.faults.disturbances import DISTURBANCES, Disturbance

FRESH = 12  # one run in so many is a new interpreter
BEGUN = re.compile(r"cli/main\.py\", line \d+, in run")  # in a traceback of ours
IN_A_ROW = 5  # disturbances before a command may go on to its end


@dataclass
class Tally:
    """What came of a command under one disturbance."""

    runs: int = 0  # that the disturbance hit
    whole: int = 0  # of these, runs after which nothing was lost or half-written
    left: int = 0  # temporary files
    restarts: int = 0
    equal: int = 0  # restarts that came to the results of an undisturbed run
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Undisturbed:
    """A case, what it comes to, and how long it takes."""

    case: Case
    before: dict[str, bytes]  # results of an earlier run
    results: dict[str, Any]
    seconds: float  # forked
    fresh_s: float


def earlier(case: Case, folder: Path) -> dict[str, bytes]:
    """What another run leaves; it is run in this process, where forks find what it loaded."""
    case.begin(folder, {})
    succeed(*case.words, *case.earlier, cwd=folder)
    return {name: (folder / name).read_bytes() for name in case.outputs}


def undisturbed(case: Case, root: Path) -> Undisturbed:
    """Run a command in a new interpreter and forked, to the same results."""
    found, took = [], []
    case.load()
    before = earlier(case, root / f"{case.words[0]}-before") if case.outputs else {}
    for fresh in (True, False):
        folder = root / f"{case.words[0]}-{fresh}"
        case.begin(folder, {})
        code, told, seconds = Child(case.typed(folder), folder, fresh=fresh).ended()
        assert code == 0, told
        found.append(case.results(folder))
        took.append(seconds)
    differ = [name for name in found[0] if found[0][name] != found[1].get(name)]
    assert not differ, (case.words, differ)
    return Undisturbed(case, before, found[0], took[1], took[0])


def disturbed(known: Undisturbed, how: Disturbance, runs: int, root: Path, seed: str) -> Tally:
    """Disturb a command so many times."""
    rng, tally = random.Random(seed), Tally()
    while tally.runs < runs and len(tally.faults) < 5:
        folder = Path(tempfile.mkdtemp(dir=root)) / "case"
        folder.parent.chmod(0o755)
        before = known.before if rng.random() < 0.5 else {}
        known.case.begin(folder, before)
        _chain(
            replace(known, before=before), how, min(IN_A_ROW, runs - tally.runs), folder, rng, tally
        )
        shutil.rmtree(folder.parent)
    return tally


def _chain(
    known: Undisturbed, how: Disturbance, most: int, folder: Path, rng: random.Random, tally: Tally
) -> None:
    """Start a command again and again, until it comes to its end."""
    for _ in range(most):
        if _ended_by_itself(known, how, folder, rng, tally):
            break
    else:
        code, told, _ = Child(known.case.typed(folder), folder).ended()
        if code:
            tally.faults.append(f"restart: exit code {code}: {told.strip()[-500:]}")
    tally.restarts += 1
    with suppress(ValueError):  # what is not whole is not equal
        if known.case.results(folder) == known.results:
            tally.equal += 1
            return
    tally.faults.append("restart: other results than undisturbed")


def _ended_by_itself(
    known: Undisturbed, how: Disturbance, folder: Path, rng: random.Random, tally: Tally
) -> bool:
    """Run and disturb a command once; whether the disturbance came too late for it."""
    case, fresh = known.case, rng.randrange(FRESH) == 0
    moment = rng.uniform(0.0, known.fresh_s if fresh else known.seconds)
    inner = random.Random(rng.random())
    before = {*hidden(folder)}
    how.before(folder)
    child = Child(case.typed(folder), folder, fresh=fresh, prepare=lambda: how.prepare(inner))
    other = None
    if how.strike:
        time.sleep(moment)
        other = how.strike(child, inner)
    ends = [one.ended() for one in (child, other) if one]
    code, told = max(code for code, _, _ in ends), "".join(told for _, told, _ in ends)
    how.after(folder)
    left = {*hidden(folder)} - before
    faults = list(case.faults(folder, known.before, known.results))
    tally.left += len(left)
    if left and not how.leaves:
        faults.append(f"left {', '.join(path.name for path in left)}")
    begun = "Traceback" not in told or BEGUN.search(told)  # or else it is Python's own, starting
    if begun and ("Traceback" in told or code not in how.codes | {0}):
        faults.append(f"exit code {code}")
    if faults:
        faults.append(f"{'fresh, ' * fresh}after {moment:.2f} s: {told.strip()[-700:]}")
    tally.faults += faults
    if code == 0 and not other:
        return True
    tally.runs += 1
    tally.whole += not faults
    return False


def table(rows: Iterable[tuple[str, str, Tally]]) -> str:
    """All tallies as Markdown."""
    header = ["command", "fault", "runs", "results whole", "left files", "restart equal"]
    return grid(header, [
        [command, fault, str(t.runs), str(t.whole), str(t.left), f"{t.equal} of {t.restarts}"]
        for command, fault, t in rows
    ])  # fmt: skip


def campaign(
    runs: int, seed: int, commands: list[str], faults: list[str]
) -> list[tuple[str, str, Tally]]:
    """Disturb commands, each in each way, and tell on the way what went wrong."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        root.chmod(0o755)
        for command in commands:
            known = undisturbed(CASES[command](), root)
            for fault in faults:
                how = DISTURBANCES[fault]
                tally = disturbed(known, how, runs, root, f"{seed} {command} {fault}")
                rows.append((command, fault, tally))
                said = "\n".join(tally.faults)
                took = f"{known.seconds:.1f} s, fresh {known.fresh_s:.1f} s"
                print(
                    f"{command} ({took}), {fault}: {tally.runs} {said}", file=sys.stderr, flush=True
                )
    return rows


def main() -> None:
    """The campaign as it is typed."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.campaign", description=__doc__)
    parser.add_argument("--runs", type=int, default=50, help="of each command, by each fault")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--faults", nargs="+", default=list(DISTURBANCES), choices=DISTURBANCES)
    args = parser.parse_args()
    begun_s = time.monotonic()
    rows = campaign(args.runs, args.seed, args.commands, args.faults)
    print(table(rows))
    print(f"\n{time.monotonic() - begun_s:.0f} s")
    sys.exit(any(tally.faults for *_, tally in rows))


if __name__ == "__main__":
    main()
