"""Threads that share jobs; they run in parallel because compiled code releases Python's lock."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import lru_cache
from itertools import pairwise
from typing import Any, TypeVar

Result = TypeVar("Result")


@lru_cache(maxsize=1)
def _helpers() -> ThreadPoolExecutor:
    """Return the threads that work on jobs together with the thread that calls :func:`share`."""
    return ThreadPoolExecutor(os.cpu_count(), "mmwave-env")


if hasattr(os, "register_at_fork"):  # a forked child has only the thread that forked
    os.register_at_fork(after_in_child=_helpers.cache_clear)


def share(
    function: Callable[..., Result], jobs: Sequence[tuple[Any, ...]], threads: int
) -> list[Result]:
    """Return the result of ``function(*job)`` for every job, in order.

    At most ``threads`` threads, including the calling thread, work in parallel. After an error or
    interrupt, no further job begins; the exception is raised once the running jobs have ended.
    """
    if threads == 1 or len(jobs) == 1:
        return [function(*job) for job in jobs]
    results: list[Any] = [None] * len(jobs)
    waiting = iter(range(len(jobs)))  # shared by the threads: next() is atomic

    def work() -> None:
        for i in waiting:
            results[i] = function(*jobs[i])

    others: list[Future[None]] = []
    try:
        others.extend(_helpers().submit(work) for _ in range(min(threads, len(jobs)) - 1))
        work()
    finally:
        for _ in waiting:  # take the remaining jobs, so that no thread begins another one
            pass
        running = [other for other in others if not other.cancel()]
        wait(running)
    for other in running:
        other.result()
    return results


def spans(count: int, parts: int) -> list[tuple[int, int]]:
    """Split ``count`` things into ``parts`` nearly equal parts; return each part's (first, end)."""
    return list(pairwise(count * i // parts for i in range(parts + 1)))
