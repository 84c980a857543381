"""What came of a case: the file was read, refused in a line, or something that must not be."""

import faulthandler
import os
import resource
import signal
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.faults.fuzz.readers import has_nan

ACCEPTED, REFUSED = "accepted", "refused in one line"
TRACEBACK, HANG, NAN, MEMORY = "traceback", "hang over 10 s", "silent NaN", "memory over 1 GB"
OUTCOMES = (ACCEPTED, REFUSED, TRACEBACK, HANG, NAN, MEMORY)
FAULTS = OUTCOMES[2:]
LONGEST_LINE = 5000  # letters of a message
PATIENCE_S = 10.0
_WATCH_S = 60.0  # after which a hang outside of Python ends the process
MEMORY_BYTES = 1 << 30
_KEPT = 5  # examples of each fault


class _TooLongError(BaseException):
    """Nothing that a reader would catch."""


def _stop(*_: Any) -> None:
    raise _TooLongError


class Tally:
    """Counts outcomes of one reader, with examples of faults.

    Memory is that of the process, beyond what it had before the first case.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.examples: list[tuple[str, str, bytes]] = []  # fault, where, content
        self._before = _peak_bytes()
        signal.signal(signal.SIGALRM, _stop)

    @property
    def cases(self) -> int:
        return sum(self.counts[outcome] for outcome in (ACCEPTED, REFUSED, TRACEBACK, HANG, NAN))

    def case(self, read: Callable[[Path], Any], folder: Path, content: bytes) -> None:
        """Read a folder, and count what came of it; ``content`` is kept of faults."""
        faulthandler.dump_traceback_later(_WATCH_S, exit=True)  # hangs outside of Python
        outcome, where = _outcome(read, folder)
        self._count(outcome, where, content)
        if _peak_bytes() - self._before > MEMORY_BYTES:
            self._count(MEMORY, outcome, content)
            Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
            self._before = min(self._before, _peak_bytes())

    def _count(self, outcome: str, where: str, content: bytes) -> None:
        self.counts[outcome] += 1
        known = [one for one in self.examples if one[:2] == (outcome, where)]
        if outcome in FAULTS and not known and self.counts[outcome] <= _KEPT * 100:
            self.examples.append((outcome, where, content))


def _outcome(read: Callable[[Path], Any], folder: Path) -> tuple[str, str]:
    """What came of a folder, and of a fault where it was."""
    try:
        signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = read(folder)
    except _TooLongError as error:
        return HANG, _place(error)
    except (ValueError, OSError) as error:
        long = len(str(error)) > LONGEST_LINE
        return (TRACEBACK, f"a message of more than {LONGEST_LINE} letters") if long else (
            REFUSED, ""
        )  # fmt: skip
    except Exception as error:
        return TRACEBACK, f"{type(error).__name__}: {str(error)[:100]!r} {_place(error)}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    return (NAN, "") if has_nan(found) else (ACCEPTED, "")


def _place(error: BaseException) -> str:
    """The innermost lines of ours and of all."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [one for one in frames if "/mmwave_env/" in one.filename or "/exper" in one.filename]
    places = [*ours[-1:], *frames[-1:]]
    return " < ".join(f"{os.path.basename(one.filename)}:{one.lineno}" for one in places)


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
