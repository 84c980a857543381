"""``python -m tests.mutation``: how many mutants of the filters the tests on floats notice.

Each mutant lives in a fork of its own, in which the collected tests run until one fails. Only
tests on floats take part: compiled functions are kept on disk by what the sources say.
"""

import argparse
import os
import random
import signal
import sys
import time
from collections import Counter
from tempfile import TemporaryDirectory

import pytest

from tests.mutation.mutants import EQUATIONS, Mutant, mutants, put_to_work
from tests.paths import ROOT

TESTS = ("test_on_floats", "test_pipeline", "test_update")
PATIENCE_S = 120  # for a mutant whose loop never ends
KILLED, SURVIVED, ENDLESS = "killed", "survived", "endless"


class Campaign:
    """A plugin of pytest: runs the collected tests once as they are, then once a mutant."""

    def __init__(self, chosen: list[Mutant]) -> None:
        self.chosen = chosen
        self.found: list[tuple[Mutant, str]] = []

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if self._fate(session, None) != SURVIVED:
            raise pytest.UsageError("the tests fail without any mutant")
        for mutant in self.chosen:
            fate = self._fate(session, mutant)
            self.found.append((mutant, fate))
            if fate == SURVIVED:
                print(f"survived: {mutant}", flush=True)
        return True

    def _fate(self, session: pytest.Session, mutant: Mutant | None) -> str:
        child = os.fork()
        if not child:
            _run_and_exit(session, mutant)
        _, status = os.waitpid(child, 0)
        if os.WIFSIGNALED(status):
            return ENDLESS if os.WTERMSIG(status) == signal.SIGALRM else KILLED
        return KILLED if os.WEXITSTATUS(status) else SURVIVED


def _run_and_exit(session: pytest.Session, mutant: Mutant | None) -> None:
    """Run the tests until one fails; the exit status tells."""
    status = 1
    try:
        if mutant is not None:
            signal.alarm(PATIENCE_S)
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            put_to_work(mutant)
        for item, following in zip(session.items, [*session.items[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if session.testsfailed:
                break
        status = int(session.testsfailed > 0)
    finally:
        os._exit(status)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--mutants", type=int, help="so many, drawn at random; all by default")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    every = list(mutants())
    chosen = random.Random(args.seed).sample(every, min(args.mutants or len(every), len(every)))
    campaign, begin = Campaign(chosen), time.monotonic()
    with TemporaryDirectory() as cache:
        os.environ["NUMBA_CACHE_DIR"] = cache  # where a mutant that is compiled harms nobody
        tests = [str(ROOT / "tests" / "filters" / f"{name}.py") for name in TESTS]
        options = ["-q", "--no-header", "-p", "no:cacheprovider", "--capture=no", "-m", "not slow"]
        code = pytest.main([*options, *tests], plugins=[campaign])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        sys.exit(int(code))
    print(_table(campaign.found, len(every), time.monotonic() - begin))


def _table(found: list[tuple[Mutant, str]], every: int, seconds: float) -> str:
    """Counts by module, as Markdown."""
    counts = Counter((mutant.module, fate) for mutant, fate in found)
    rows = [
        [module, *(counts[module, fate] for fate in (KILLED, ENDLESS, SURVIVED))]
        for module in EQUATIONS
    ]
    total = [sum(row[i] for row in rows) for i in (1, 2, 3)]
    share = 1.0 - total[2] / max(sum(total), 1)
    lines = ["", "| module | killed | endless | survived |", "|---|---|---|---|"]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in [*rows, ["all", *total]]]
    told = f"{sum(total)} of {every} mutants, {share:.1%} noticed, {seconds:.0f} s"
    return "\n".join([*lines, "", told])


if __name__ == "__main__":
    main()
