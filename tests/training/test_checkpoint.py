"""Tests of checkpoints of training runs (valid, damaged and forged), and of progress logs."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("stable_baselines3")

import torch

from experiments.training.checkpoint import read_checkpoint, write_checkpoint
from experiments.training.ppo import PpoTraining
from experiments.training.record import ProgressLog
from tests.damage import Malicious, damaged
from tests.refusals import refuses
from tests.training.test_train import job_of

pytestmark = pytest.mark.torch

STATE = {
    "word": "ä", "none": None, "flag": True, "list": [1, 2.5],
    "tensor": torch.tensor([[1.5, 2.0]]),
}  # fmt: skip


@pytest.fixture
def path(tmp_path):
    """Write a checkpoint and return its path."""
    path = tmp_path / "checkpoint.pt"
    write_checkpoint(path, STATE)
    return path


SCOPED = [HealthCheck.function_scoped_fixture]


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=SCOPED)
@given(data=st.data())
def test_a_damaged_checkpoint_is_read_or_refused(path, data):
    write_checkpoint(path, STATE)
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        read_checkpoint(path)
    except ValueError as error:
        refusal = str(error)
    else:
        return
    assert "checkpoint.pt: not a checkpoint: " in refusal


BEGIN = {"update": 0, "timesteps": 0, "best": None, "beat_rule": None, "seconds": 0.0, "rows": []}


def test_a_checkpoint_that_lacks_entries_of_the_learner_is_refused(path, tmp_path):
    write_checkpoint(path, BEGIN | {"learner": {"timesteps": 3}})
    with refuses("checkpoint.pt", "updates"):
        PpoTraining(job_of(tmp_path), lambda *_: None).run()


def test_a_malicious_checkpoint_is_refused_and_not_executed(path, tmp_path):
    trap = tmp_path / "trap"
    write_checkpoint(path, {"update": 1, "learner": Malicious(trap)})
    with refuses("checkpoint.pt"):
        read_checkpoint(path)
    assert not trap.exists()


def test_the_progress_log_writes_one_row_per_call_and_can_be_continued(tmp_path):
    log = ProgressLog(tmp_path, [])
    log.write({"a": 1, "time/fps": 9}, {}, 10)
    log.write({"b": np.float32(0.123456789)}, {}, 20)
    log.save()
    assert (tmp_path / "progress.csv").read_text() == "timesteps,a,b\n10,1,\n20,,0.123457\n"
    log.write({"lost": 1}, {}, 30)
    again = ProgressLog(tmp_path, log.rows[:2])
    again.write({"a": 2, "c": 3}, {}, 30)
    again.save()
    assert (tmp_path / "progress.csv").read_text() == (
        "timesteps,a,b,c\n10,1,,\n20,,0.123457,\n30,2,,3\n"
    )
