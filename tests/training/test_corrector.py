"""Tests of training correctors of beliefs. A *lot* is a batch of equally long episodes."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")
import torch

from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.protocol import judge, sites
from experiments.training.corrector import CorrectorTrainer, loss_of, mixed
from experiments.training.corrector_data import WEAVING_BEHIND_M, begin_from_a_link, weaving
from experiments.training.hyperparameters import CorrectorHyperparameters, TwoWayHyperparameters
from experiments.training.networks import RecurrentUnit
from experiments.training.run import train
from experiments.training.trainer import Job
from mmwave_env.metrics import BURN_IN
from mmwave_env.models.measurement import blank_site
from mmwave_env.models.random_scene import WIDE_SCENE
from mmwave_env.numerics.pytree import indices
from mmwave_env.world.episode import columns_of
from policies import Corrector
from policies.corrector import TwoWayCorrector
from tests.filters.tracks import nees_of
from tests.paths import representative
from tests.training.test_rollout_env import task
from tests.training.test_train_interrupted import assert_goes_on, silent, trained

pytestmark = pytest.mark.torch

SEED = 10_000_000
HYPER = CorrectorHyperparameters(
    base="imm-best", num_envs=8, batch_size=4, judged_at=("street:handset",), random_share=0.5,
    long_epochs=250, front=8, units=6, head=8, members=2, likelihood_weight=0.1,
    learning_rate=0.003, final_fraction=0.1, max_grad_norm=1.0,
)  # fmt: skip
# tracks are smoothed, and policies are compared with a radio that the training does not use
TWO_WAY = TwoWayHyperparameters(**vars(HYPER) | {"judged_at": ("street:high",)}, rounds=1)


def job_of(folder, hyper=HYPER, **changes):
    job = Job(task(), hyper, 0, 40_000, folder, "mmwave-loc train", 8)
    return replace(job, **changes)


@pytest.fixture(scope="module")
def lots():
    return CorrectorTrainer(job_of(None), SEED).play(1)


@pytest.mark.slow
def test_every_episode_is_in_one_mixed_lot_and_a_mixed_lot_combines_several_lots(lots):
    shuffled = list(mixed(lots, 4, np.random.default_rng(0)))
    assert all(lot.error.shape[1] * len(lot.error) <= 5 * HYPER.long_epochs for lot in shuffled)

    def episodes(lot):
        return [lot.error[:, i].tobytes() for i in range(lot.error.shape[1])]

    origin = {episode: i for i, lot in enumerate(lots) for episode in episodes(lot)}
    assert sorted(e for lot in shuffled for e in episodes(lot)) == sorted(origin)
    assert max(len({origin[e] for e in episodes(lot)}) for lot in shuffled) > 1


def test_weaving_users_move_along_both_street_axes_and_their_velocity_fits_their_positions():
    scene = replace(WIDE_SCENE, behind_m=WEAVING_BEHIND_M)
    source = replace(task().places[0].source("mixed"), dt=0.1, scene=scene)
    rows = np.concatenate(weaving(source, np.random.default_rng(1)).ways.tables)
    velocity = (rows[2:, :2] - rows[:-2, :2]) / 0.2
    assert np.median(np.abs(velocity - rows[1:-1, 3:5])) < 0.05
    moving = rows[np.linalg.norm(rows[:, 3:5], axis=1) > 0.5, 3:5]
    # Other users move along one axis at a time, except in corners.
    assert (np.abs(moving).min(axis=1) > 0.01).mean() > 0.8


def test_episodes_begin_from_a_link_that_filters_do_not_use_again():
    source = task().places[0].source("mixed")
    batch = source.sample_batch(np.arange(SEED, SEED + 64, dtype=np.uint64))
    before = batch.table.copy()
    begin_from_a_link(batch, source)
    at = columns_of(batch.layout)
    spent = (before[:, :, at.signed_sigma] > 0.0) & (batch.table[:, :, at.signed_sigma] < 0.0)
    assert (spent[:, 0].sum(axis=1) == 4).mean() > 0.9 and not spent[:, 1:].any()
    index = indices(blank_site(batch.layout))
    error = batch.site[:, index.prior_x[:3]] - batch.table[:, 0, at.truth[:3]]
    nees = nees_of(error, batch.site[:, index.prior_P])
    assert 1.5 < np.median(nees) < 4.0  # 2.4 if errors are Gaussian; reflections have larger ones


@pytest.mark.parametrize("two_way", representative([False, True], True))
def test_a_recurrent_unit_and_its_gradients_equal_those_of_pytorch(two_way):
    torch.manual_seed(0)
    ours = RecurrentUnit(5, 6, bidirectional=two_way)
    reference = torch.nn.GRU(5, 6, bidirectional=two_way)
    reference.load_state_dict(ours.state_dict())
    x = torch.randn(30, 4, 5, requires_grad=True)
    weight = torch.randn(6 * (1 + two_way))
    states = ours(x)
    expected, _ = reference(x)
    torch.testing.assert_close(states, expected)
    slopes = torch.autograd.grad((states * weight).square().sum(), [x, *ours.parameters()])
    loss = (expected * weight).square().sum()
    for slope, expected_slope in zip(
        slopes, torch.autograd.grad(loss, [x, *reference.parameters()]), strict=True
    ):
        torch.testing.assert_close(slope, expected_slope, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_no_episode_is_played_twice():
    trainer = CorrectorTrainer(job_of(None), SEED)
    first, second = (trainer.play(1)[0] for _ in range(2))
    epochs, n, _ = np.minimum(first.error.shape, second.error.shape)
    assert (first.error[:epochs, :n] != second.error[:epochs, :n]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("hyper", "reader"), [(HYPER, Corrector), (TWO_WAY, TwoWayCorrector)])
def test_an_interrupted_training_goes_on(tmp_path, hyper, reader):
    job = job_of(tmp_path, hyper)
    assert_goes_on(job)
    assert reader(job.policy).card.algorithm == hyper.algorithm


@pytest.mark.slow
def test_the_policy_file_gives_the_corrections_of_the_network(tmp_path, lots):
    job = job_of(tmp_path)
    trainer = trained(job, CorrectorTrainer)
    corrector = Corrector(job.policy)
    assert corrector.card.base == "imm-best"
    lot = lots[0]
    corrector.reset(np.ones(lot.features.shape[1], bool))
    with torch.no_grad():
        shift, _ = trainer.answer(lot)
    for features, expected in zip(lot.features, shift.mean(2).numpy(), strict=True):
        answer = corrector.correct(features)
        np.testing.assert_allclose(
            answer.shift, expected * answer.trusted[:, None], atol=2e-4 + 1e-3 * abs(expected).max()
        )


def test_the_loss_is_smallest_for_the_true_shift_and_standard_deviation():
    rng = np.random.default_rng(0)
    T = BURN_IN + 400
    n = 3
    bias = torch.tensor([0.5, -1.0, 2.0])
    deviation = torch.full((T, n, 3), 2.0)
    noise = torch.from_numpy(rng.normal(0.0, 1.5, (T, n, 3))).float()
    error = deviation * bias + noise

    def loss(shift, factor):
        answer = shift.expand(T, n, 1, 3), torch.full((T, n, 1, 3), float(np.log(factor)))
        return loss_of(answer, error, deviation, 1.0).mean()

    best = loss(bias, 0.75)
    for shift, factor in ((bias + 0.3, 0.75), (0.0 * bias, 0.75), (bias, 0.5), (bias, 1.2)):
        assert best < loss(shift, factor)


@pytest.mark.slow
def test_a_short_training_beats_its_base(tmp_path):
    """Compare with a run that learns almost nothing, so that its policy is nearly the base."""
    policies = []
    for rate, timesteps in ((1e-12, 1), (0.005, 1_200_000)):
        hyper = replace(HYPER, num_envs=16, front=16, units=16, head=16, learning_rate=rate)
        folder = tmp_path / str(timesteps)
        folder.mkdir()
        train(job_of(folder, hyper, timesteps=timesteps), silent)
        policies.append(str(folder / "policy.safetensors"))
    base, trained = policies
    scores = judge(policies, sites()[0], 200, seed=5_000_000)
    gain = scores[trained]["reward"] - scores[base]["reward"]
    (interval,) = bootstrap([gain])
    assert 0.0 < interval.low
