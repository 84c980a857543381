"""Tests that the scores of a corrector are the metrics of the corrected beliefs."""

import numpy as np
import pytest

from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import run_contender, score
from mmwave_env.filters.bank import Bank
from mmwave_env.task import task_from
from tests.policies.test_corrector import card, network
from tests.training.actors import PER_MODE, write

N, EPOCHS = 4, 60


@pytest.fixture(scope="module")
def episodes():
    source = task_from(episode_steps=EPOCHS).simulated
    return source.episodes(np.arange(N, dtype=np.uint64))


@pytest.fixture(scope="module")
def base():
    bank: Bank = PER_MODE["banks"]["handset"]
    return Contender("imm", bank, None)


def contender_with(path, tensors):
    return Contender.learned(write(path, tensors, card()), "mine", "handset")


def run(contender, episodes):
    policy = contender.start(episodes[0].layout)
    return run_contender(contender, policy, episodes, after=("x", "P"))


def test_a_corrector_that_corrects_nothing_scores_as_its_base(tmp_path, episodes, base):
    tensors = network()
    tensors["out.weight"][:], tensors["out.bias"][:] = 0.0, 0.0
    mine = contender_with(tmp_path / "nothing.safetensors", tensors)
    ours, theirs = (score(each, each.start(episodes[0].layout), episodes) for each in (mine, base))
    for metric, values in theirs.items():
        np.testing.assert_allclose(ours[metric], values, rtol=1e-9, atol=1e-9)


def test_errors_and_nees_are_those_of_the_corrected_beliefs(tmp_path, episodes, base):
    results = run(contender_with(tmp_path / "mine.safetensors", network(limit=50.0)), episodes)
    truth = np.stack([episode.truth_position_m for episode in episodes])
    error = results["x"][..., :3] - truth
    np.testing.assert_allclose(results["error"], error, atol=1e-9)
    P = np.zeros((N, EPOCHS, 3, 3))
    i, j = np.tril_indices(3)
    P[..., i, j] = P[..., j, i] = results["P"][..., :6]
    nees = np.einsum("nti,ntij,ntj->nt", error, np.linalg.inv(P), error)
    np.testing.assert_allclose(results["nees"], nees, rtol=1e-6)
    length = np.minimum(np.linalg.norm(error, axis=-1), 10.0)
    odd = np.minimum(np.abs(np.log(np.maximum(nees, 1e-12) / 3.0)), 3.0)
    np.testing.assert_allclose(results["reward"], -length - 0.2 * odd, atol=1e-6)
    assert (results["error"] != run(base, episodes)["error"]).any(axis=-1).mean() > 0.9
