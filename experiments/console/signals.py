"""Signals from a scheduler or a closed terminal: the program ends as after Ctrl-C."""

import os
import signal
from threading import Timer
from types import FrameType

# Signals that end the program, if the system has them; Windows has no SIGHUP.
ENDING = tuple(getattr(signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n))
SOON_S = 0.01  # delay after which a signal that could not be handled is sent again


def heed_signals() -> None:
    """From now on, let SIGTERM and SIGHUP raise a KeyboardInterrupt, so that cleanup code runs.

    The exception's argument is the signal's number. Already ignored signals (nohup) stay ignored.
    """
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    if _in_callback(frame):
        Timer(SOON_S, os.kill, (os.getpid(), number)).start()
        return
    # A scheduler may send a signal twice, to the process and to its group.
    for other in ENDING:
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt(number)


def _in_callback(frame: FrameType | None) -> bool:
    """Return whether the running code is a callback from C code that would drop exceptions."""
    while frame is not None:
        if frame.f_code.co_name.startswith("_raw_object_cache"):  # a callback of llvmlite
            return True
        frame = frame.f_back
    return False
