"""Where the time of a training goes."""

import pytest

pytest.importorskip("stable_baselines3")

from experiments.training import speed
from experiments.training.speed import ENVIRONMENT, OTHER, UPDATE, Stopwatch

pytestmark = pytest.mark.torch


class Work:
    """Takes three seconds and one, by its own clock."""

    now = 0.0

    def outer(self):
        self.now += 3.0
        return self.inner(1)

    def inner(self, x):
        self.now += 1.0
        if x < 0:
            raise ValueError("negative")
        return x + 1


def test_a_part_does_not_count_what_another_does_in_it(monkeypatch):
    work = Work()
    monkeypatch.setattr(speed.time, "perf_counter", lambda: work.now)
    watch = Stopwatch()
    watch.watch(work, "outer", UPDATE)
    watch.watch(work, "inner", ENVIRONMENT)
    work.now += 7.0
    watch.start()
    assert work.outer() == 2
    with pytest.raises(ValueError, match="negative"):
        work.inner(-1)
    work.now += 0.5
    watch.stop()
    assert {part: spent for part, spent in watch.seconds.items() if spent} == {
        UPDATE: 3.0, ENVIRONMENT: 2.0, OTHER: 0.5,
    }  # fmt: skip
