"""Readers read what is good, the fuzzer tells outcomes apart, and damaged files find nothing."""

import faulthandler
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("torch")  # of trainings

from tests.faults.fuzz import outcomes
from tests.faults.fuzz.outcomes import ACCEPTED, HANG, MEMORY, NAN, REFUSED, TRACEBACK, Tally
from tests.faults.fuzz.readers import READERS, has_nan
from tests.paths import ROOT

pytestmark = pytest.mark.torch
CASES = 2000


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_what_damage_begins_with_is_good(tmp_path, reader):
    good = reader.good()
    for name, content in good.items():
        reader.write(tmp_path, name, content)
    assert not has_nan(reader.read(tmp_path))
    for name, content in reader.also.items():
        assert name in good
        reader.write(tmp_path, name, content)
        reader.read(tmp_path)


def refuse(_):
    raise ValueError("log.csv, row 1: found nothing")


def speak_on(_):
    raise ValueError("x" * 6000)


def fail(_):
    raise KeyError("anchors")


def wait(_):
    time.sleep(60.0)


def fill(_):
    return None  # what it takes is told by the test


READS = [
    (lambda _: [1.0, {"a": np.zeros(3)}], ACCEPTED), (refuse, REFUSED), (speak_on, TRACEBACK),
    (fail, TRACEBACK), (wait, HANG), (lambda _: (2, [np.array([0.0, np.nan])]), NAN),
    (fill, MEMORY),
]  # fmt: skip


@pytest.mark.parametrize(("read", "outcome"), READS, ids=[name for _, name in READS])
def test_outcomes_are_told_apart(tmp_path, monkeypatch, read, outcome):
    monkeypatch.setattr(outcomes, "PATIENCE_S", 0.3)
    monkeypatch.setattr(outcomes, "_WATCH_S", 30.0)
    monkeypatch.setattr(outcomes, "_peak_bytes", iter([0, (2 << 30) * (read is fill), 0]).__next__)
    before, tally = signal.getsignal(signal.SIGALRM), Tally()
    try:
        tally.case(read, tmp_path, b"content")
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, before)
    assert tally.counts[outcome] == 1 and tally.cases == 1
    assert bool(tally.examples) == (outcome in outcomes.FAULTS)


@pytest.mark.slow
def test_no_reader_is_led_astray():
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "tests.faults.fuzz", "--cases", str(CASES)]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-3000:] + ended.stdout
    rows = [line for line in ended.stdout.splitlines() if line.startswith("| ")]
    for reader in READERS:
        (row,) = [row for row in rows if row.startswith(f"| {reader.name} |")]
        assert f"| {CASES} |" in row
