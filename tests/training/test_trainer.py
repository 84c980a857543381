"""Tests of the frame of trainings: checkpoints, which may be valid, damaged or forged."""

import io

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("stable_baselines3")

import torch

from experiments.training.run import train
from experiments.training.trainer import Progress, read_checkpoint
from tests.damage import Malicious, damaged
from tests.refusals import refuses
from tests.training.test_train import job_of
from tests.training.test_train_interrupted import silent

pytestmark = pytest.mark.torch


PROGRESS = Progress(3, 96, 1.5, [{"timesteps": 96, "seconds": 1.5}], {"reward": -1.5})


def written(path, trainer):
    """Write a checkpoint with a trainer's state to a file; return the path."""
    memory = io.BytesIO()
    torch.save({"progress": vars(PROGRESS), "trainer": trainer}, memory)
    path.write_bytes(memory.getvalue())
    return path


SCOPED = [HealthCheck.function_scoped_fixture]


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=SCOPED)
@given(data=st.data())
def test_a_damaged_checkpoint_is_read_or_refused(tmp_path, data):
    path = written(tmp_path / "checkpoint.pt", {"weight": torch.ones(2, 2)})
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    try:
        read_checkpoint(path)
    except ValueError as error:
        refusal = str(error)
    else:
        return
    assert "checkpoint.pt: not a checkpoint: " in refusal


def test_a_checkpoint_that_lacks_entries_of_the_trainer_is_refused(tmp_path):
    job = job_of(tmp_path)
    written(job.checkpoint, {"timesteps": 3})
    with refuses("checkpoint.pt", "network"):
        train(job, silent)


def test_a_malicious_checkpoint_is_refused_and_not_executed(tmp_path):
    trap = tmp_path / "trap"
    path = written(tmp_path / "checkpoint.pt", Malicious(trap))
    with refuses("checkpoint.pt"):
        read_checkpoint(path)
    assert not trap.exists()
