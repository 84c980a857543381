"""Engines compute every cell, try again what fails, and survive the death of a worker."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from experiments.sweeping import worker
from experiments.sweeping.cell import Cell
from experiments.sweeping.engines import local, on_ray

pytestmark = pytest.mark.slow
CELLS = [Cell("evaluate", (("number", n),)) for n in range(20)]


def square(cell):
    ((_, number),) = cell.values
    return {"square": number**2}


def moody(cell):
    """Fails at the first try of odd numbers, always at 13, and ends its process once at 4."""
    number, folder = dict(cell.values)["number"], Path(os.environ["MOODY"])
    tried = folder / str(number)
    first = not tried.exists()
    tried.touch()
    if number == 4 and first:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 13 or (number % 2 and first):
        raise ValueError(f"moody about {number}")
    return square(cell)


@pytest.fixture(params=[local, on_ray])
def engine(request, monkeypatch):
    if request.param is on_ray:
        pytest.importorskip("ray")
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    monkeypatch.setenv("PYTHONPATH", path)  # workers import this module
    return request.param


def test_every_cell_is_computed_once(engine):
    found = {done.cell: done.result for done in engine(square, CELLS, 2, 1)}
    assert found == {cell: square(cell) for cell in CELLS}


def test_what_fails_is_tried_again_and_then_told(engine, tmp_path, monkeypatch):
    monkeypatch.setenv("MOODY", str(tmp_path))
    found = {dict(done.cell.values)["number"]: done for done in engine(moody, CELLS, 2, 3)}
    assert sorted(found) == list(range(20))
    assert [n for n, done in found.items() if done.result is None] == [13]
    assert "moody about 13" in found[13].error
    assert all(found[n].result == {"square": n**2} for n in range(20) if n != 13)


def deadly(cell):
    """Ends its process always at 0; beside it others are at work for longer."""
    time.sleep(0.2 if dict(cell.values)["number"] == 0 else 0.6)
    if dict(cell.values)["number"] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return square(cell)


def test_a_cell_that_ends_its_process_costs_no_other_a_try(engine):
    found = {dict(done.cell.values)["number"]: done for done in engine(deadly, CELLS[:6], 2, 2)}
    assert sorted(found) == list(range(6))
    assert [n for n, done in found.items() if done.result is None] == [0]


def test_workers_ended_between_two_cells_lose_none():
    found = list[int]()
    for done in local(square, CELLS, 2, 20):
        found.append(dict(done.cell.values)["number"])
        if len(found) in (3, 9):
            for child in multiprocessing.active_children():
                child.kill()
            time.sleep(0.5)  # until they are gone
    assert sorted(found) == list(range(20))


def large(cell):
    """A result that does not fit into a pipe, but of the first cell."""
    return {"square": b"x" * (1 << 20) if dict(cell.values)["number"] else b""}


def test_a_worker_ended_within_an_answer_costs_a_try():
    found = list[int]()
    for done in local(large, CELLS[:4], 1, 2):
        found.append(len(done.result["square"]))
        if len(found) == 1:
            time.sleep(1.0)  # until it waits for somebody to read the rest
            for child in multiprocessing.active_children():
                child.kill()
    assert found == [0, 1 << 20, 1 << 20, 1 << 20]


def deaf(cell):
    """Does not hear that it is to end, as C code; but for the first cell."""
    if dict(cell.values)["number"]:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        time.sleep(600.0)
    return square(cell)


def test_a_worker_that_does_not_hear_is_ended_all_the_same(monkeypatch):
    monkeypatch.setattr(worker, "_PATIENCE_S", 0.5)
    running = local(deaf, CELLS[:2], 1, 1)
    next(running)
    time.sleep(0.5)
    running.close()
    assert not multiprocessing.active_children()


def test_whoever_stops_listening_ends_the_workers():
    running = local(square, CELLS, 2, 1)
    next(running)
    running.close()  # as an interrupt does


def test_nothing_to_do_is_done(engine):
    assert list(engine(square, [], 2, 1)) == []
