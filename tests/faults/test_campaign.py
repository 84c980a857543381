"""The campaign in small: every command, disturbed in every way, keeps and brings whole files."""

import os

import pytest

pytest.importorskip("stable_baselines3")
pytest.importorskip("pyarrow")

import torch

from tests.faults.campaign import campaign, table
from tests.faults.cases import CASES
from tests.faults.disturbances import DISTURBANCES

pytestmark = [
    pytest.mark.torch,
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="disturbs what it forked"),
]
RUNS = 1  # of each command, by each fault


@pytest.fixture(autouse=True)
def one_thread():
    """Threads would not survive a fork."""
    torch.set_num_threads(1)


@pytest.mark.parametrize("command", CASES)
def test_nothing_is_lost_or_half_written_and_it_goes_on(command):
    rows = campaign(RUNS, 1, [command], list(DISTURBANCES))
    assert [tally.faults for *_, tally in rows] == [[] for _ in DISTURBANCES]
    assert all(tally.runs == tally.whole == RUNS for *_, tally in rows)
    assert all(tally.equal == tally.restarts > 0 for *_, tally in rows)
    assert table(rows).count(f"| {command} |") == len(DISTURBANCES)
