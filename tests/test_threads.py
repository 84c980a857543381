"""Jobs shared among threads."""

import threading
import time

import pytest

from mmwave_env.threads import share


@pytest.mark.parametrize("threads", [1, 2, 3, 50])
@pytest.mark.parametrize("jobs", [0, 1, 2, 20])
def test_results_come_in_order(threads, jobs):
    assert share(lambda a, b: a * b, [(i, 2) for i in range(jobs)], threads) == [
        2 * i for i in range(jobs)
    ]


def test_no_more_threads_work_than_allowed():
    seen = set()

    def job():
        time.sleep(0.002)
        seen.add(threading.get_ident())

    share(job, [()] * 40, 2)
    assert threading.get_ident() in seen and len(seen) == 2
    seen.clear()
    share(job, [()] * 4, 1)
    assert seen == {threading.get_ident()}


@pytest.mark.parametrize("wrong", [0, 7])
def test_errors_come_through(wrong):
    with pytest.raises(ZeroDivisionError):
        share(lambda i: 1 / (i - wrong), [(i,) for i in range(8)], 2)
