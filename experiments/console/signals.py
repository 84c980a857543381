"""Signals from a scheduler or a closed terminal: the program cleans up as after Ctrl-C."""

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from threading import Timer
from types import FrameType
from typing import Any

# Signals that end the program, if the system has them; Windows has no SIGHUP.
ENDING = tuple(getattr(signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n))
SOON_S = 0.01  # delay after which a signal that could not be handled is sent again


class Ended(SystemExit):
    """An exit that a signal caused, with the exit code that shells expect."""

    def __init__(self, number: int) -> None:
        super().__init__(128 + number)
        self.message = f"ended by {signal.Signals(number).name}"


@contextmanager
def answered(
    numbers: Sequence[int], answer: Callable[[int, Any], None] | signal.Handlers
) -> Iterator[None]:
    """Handle signals in the block with ``answer``; already ignored signals (nohup) stay ignored."""
    with ExitStack() as restored:
        for number in numbers:
            if signal.getsignal(number) is not signal.SIG_IGN:
                restored.callback(signal.signal, number, signal.signal(number, answer))
        yield


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise an exception on SIGTERM or SIGHUP in the block, so that half-written files are removed.

    Raises:
        Ended: one of the signals arrived.
    """
    came = []

    def end(number: int, frame: FrameType | None) -> None:
        if _in_callback(frame):
            Timer(SOON_S, os.kill, (os.getpid(), number)).start()
            return
        ignore_signals()
        came.append(number)
        raise Ended(number)

    with answered(ENDING, end):
        try:
            yield
        except BaseException as other:
            # Another exception may have replaced Ended, in Ray's C code or in a progress bar.
            if came and not isinstance(other, Ended):
                raise Ended(came[0]) from None
            raise


def _in_callback(frame: FrameType | None) -> bool:
    """Return whether the running code is a callback from C code that would drop exceptions."""
    while frame is not None:
        if frame.f_code.co_name.startswith("_raw_object_cache"):  # a callback of llvmlite
            return True
        frame = frame.f_back
    return False


def ignore_signals() -> None:
    """Ignore further signals: a scheduler may send one twice, to the process and to its group."""
    for number in ENDING:
        signal.signal(number, signal.SIG_IGN)
