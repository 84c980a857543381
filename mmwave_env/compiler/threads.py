"""Sharing jobs among threads. Kernels run without the interpreter's lock, so that it pays."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from itertools import pairwise
from threading import Lock
from typing import Any, TypeVar

from mmwave_env.compiler.lanes import WIDTH

Result = TypeVar("Result")


@lru_cache(maxsize=1)
def _helpers() -> ThreadPoolExecutor:
    """The threads of this process that work beside the calling one."""
    return ThreadPoolExecutor(os.cpu_count(), "mmwave-env")


if hasattr(os, "register_at_fork"):  # a forked child has no threads but its own
    os.register_at_fork(after_in_child=_helpers.cache_clear)


def share(
    function: Callable[..., Result], jobs: Sequence[tuple[Any, ...]], threads: int
) -> list[Result]:
    """What ``function(*job)`` returns for every job, in order.

    At most ``threads`` of them work at once, the calling one among them. After an error or an
    interrupt no further job begins, and those under way have ended when it comes through.
    """
    if threads == 1 or len(jobs) == 1:
        return [function(*job) for job in jobs]
    found: list[Any] = [None] * len(jobs)
    waiting = iter(range(len(jobs)))  # next() is atomic

    def work(here: Lock) -> None:
        with here:
            for i in waiting:
                found[i] = function(*jobs[i])

    # Not by their futures: an interrupt may come before the one of a job under way is known.
    places = [Lock() for _ in range(min(threads, len(jobs)) - 1)]
    others: list[Future[None]] = []
    try:
        others.extend(_helpers().submit(work, place) for place in places)
        work(Lock())
    finally:
        for _ in waiting:  # whoever has not begun finds nothing to do
            pass
        for place in places:
            with place:
                pass
    for other in others:
        if not other.cancel():
            other.result()
    return found


def spans(count: int, parts: int) -> list[tuple[int, int]]:
    """First and end of so many parts of ``count`` things, as equal as can be."""
    return list(pairwise(count * i // parts for i in range(parts + 1)))


def portions(count: int, threads: int, most: int) -> list[slice]:
    """Slices of ``count`` things to share: whole blocks of lanes, of at most ``most`` things."""
    size = min(most, -(-count // (threads * WIDTH)) * WIDTH)
    return [slice(first, first + size) for first in range(0, count, size)]
