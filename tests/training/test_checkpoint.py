"""Tests of checkpoints of training runs (valid, damaged and forged), and of progress logs."""

from hashlib import sha256

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("stable_baselines3")

import torch

from experiments.training.checkpoint import read_checkpoint, with_arrays, write_checkpoint
from experiments.training.ppo import PpoTraining
from experiments.training.record import ProgressLog
from tests.damage import Malicious, damaged
from tests.refusals import refuses
from tests.training.test_train import job_of

pytestmark = pytest.mark.torch

STATE = {
    "words": "ä", "none": None, "flag": True, "list": [1, 2.5, ("a", -1)],
    "arrays": {"single": np.arange(6, dtype=np.float32).reshape(2, 3)[:, ::2],
               "words": np.array([2**32 - 1], np.uint32), "big": np.array([2**63], np.uint64),
               "flags": np.array([True, False]), "small": np.array([255], np.uint8)},
    "number": np.float64(0.1), "tensor": torch.tensor([1.5]),
}  # fmt: skip


@pytest.fixture
def path(tmp_path):
    """Write a checkpoint and return its path."""
    path = tmp_path / "checkpoint.pt"
    write_checkpoint(path, STATE)
    return path


def test_a_checkpoint_is_read_back_as_it_was_written(path):
    state = read_checkpoint(path)
    for key in ("words", "none", "flag", "list", "number", "tensor"):
        assert state[key] == STATE[key]
    for key, array in with_arrays(state["arrays"]).items():
        np.testing.assert_array_equal(array, STATE["arrays"][key])
        assert array.dtype == STATE["arrays"][key].dtype


def test_a_checkpoint_is_refused_wherever_it_is_damaged(path):
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [b"", whole[:10], whole[:-1], whole + b"x", b"text\n"]
    for place in rng.integers(len(whole), size=60):
        bit = 1 << int(rng.integers(8))
        damaged.append(whole[:place] + bytes([whole[place] ^ bit]) + whole[place + 1 :])
    for content in damaged:
        path.write_bytes(content)
        with refuses("checkpoint.pt"):
            read_checkpoint(path)


SCOPED = [HealthCheck.function_scoped_fixture]


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=SCOPED)
@given(data=st.data())
def test_a_forged_checkpoint_with_a_correct_checksum_is_read_or_refused(path, data):
    write_checkpoint(path, STATE)
    content = data.draw(damaged(path.read_bytes()[32:]))  # the checksum has 32 bytes
    path.write_bytes(sha256(content).digest() + content)
    try:
        read_checkpoint(path)
    except ValueError as error:
        refusal = str(error)
    else:
        return
    assert "checkpoint.pt: not a checkpoint: " in refusal


BEGIN = {"update": 0, "timesteps": 0, "best": None, "beat_rule": None, "seconds": 0.0, "rows": []}


def test_a_checkpoint_that_lacks_entries_of_the_learner_is_refused(path, tmp_path):
    """Check that a correct format and a correct checksum are not enough."""
    write_checkpoint(path, BEGIN | {"learner": {"timesteps": 3}, "env": {}})
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
