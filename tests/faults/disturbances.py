"""What is done to a running command, or to where it writes."""

import ctypes
import os
import random
import resource
import signal
import stat
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.faults.child import Child

PR_CAPBSET_DROP = 24
DAC_CAPABILITIES = (1, 2)  # to write and to read against modes
LOG2_BYTES = (6.0, 14.0)  # room left for a file: less or more than results need
FUTURE_S = 10 * 365 * 86400.0


def _nothing(*_: object) -> None:
    pass


@dataclass(frozen=True)
class Disturbance:
    """One way to get between a command and its results.

    Attributes:
        codes: with which a command may end that was disturbed.
        strike: what is done while it runs, at a random moment; returns a command that runs beside.
        prepare: called in its process before it begins.
        before: done to its folder before it begins; ``after``: when it has ended.
        leaves: whether temporary files may stay.
    """

    codes: frozenset[int]
    strike: Callable[[Child, random.Random], Child | None] | None = None
    prepare: Callable[[random.Random], None] = _nothing
    before: Callable[[Path], None] = _nothing
    after: Callable[[Path], None] = _nothing
    leaves: bool = False


def _signal(number: int, *, terminal: bool) -> Disturbance:
    """To all processes, as a terminal sends it, or else now and then to the command's own alone."""

    def strike(child: Child, rng: random.Random) -> None:
        child.send(number, to_all=terminal or rng.random() < 0.5)

    killed = number == signal.SIGKILL
    # The system ends it, too, as long as it has not begun to heed signals, nor to write.
    return Disturbance(frozenset({-number, 128 + number}), strike, leaves=killed)


def _full_disk(rng: random.Random) -> None:
    most = int(2.0 ** rng.uniform(*LOG2_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))


def _read_only(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        path.chmod(path.stat().st_mode & ~(stat.S_IWUSR | stat.S_IWGRP | stat.S_IWOTH))


def _writable(folder: Path) -> None:
    for path in (folder, *folder.rglob("*")):
        path.chmod(path.stat().st_mode | stat.S_IWUSR)


def _bound_by_modes(_: random.Random) -> None:
    """Take from the superuser what others do not have: writing where the mode forbids it."""
    if os.geteuid() != 0:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    version = struct.pack("=Ii", 0x20080522, 0)
    held = ctypes.create_string_buffer(24)  # effective, permitted, inheritable; then higher ones
    libc.capget(version, held)
    for number in DAC_CAPABILITIES:
        libc.prctl(PR_CAPBSET_DROP, number, 0, 0, 0)  # for the programs that it starts
    words = [
        word & ~sum(1 << n for n in DAC_CAPABILITIES) for word in struct.unpack("=3I", held[:12])
    ]
    if libc.capset(version, struct.pack("=3I", *words) + held[12:]):
        raise OSError(ctypes.get_errno(), "capset")


def _beside(child: Child, _: random.Random) -> Child:
    return Child(child.words, child.folder)


def _from_the_future(folder: Path) -> None:
    """As files look when the clock was set back."""
    later = time.time() + FUTURE_S
    for path in (folder, *folder.rglob("*")):
        os.utime(path, (later, later))


_KILL = _signal(signal.SIGKILL, terminal=False)
SIGNALS = {
    "KILL": _KILL,
    "TERM": _signal(signal.SIGTERM, terminal=False),
    "HUP": _signal(signal.SIGHUP, terminal=True),
    "INT": _signal(signal.SIGINT, terminal=True),
}
DISTURBANCES = SIGNALS | {
    "full disk": Disturbance(frozenset({2}), prepare=_full_disk),
    "read-only folder": Disturbance(
        frozenset({2}), prepare=_bound_by_modes, before=_read_only, after=_writable
    ),
    "two at once": Disturbance(frozenset({2}), _beside),
    "KILL, clock set back": Disturbance(
        _KILL.codes, _KILL.strike, after=_from_the_future, leaves=True
    ),
}
