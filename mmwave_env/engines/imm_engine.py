"""Filtering with interacting multiple models (IMM), whole episodes in one call.

Compiled code need not stop between epochs, because there is no agent or all actions are known.
Transition probabilities, process noise and NIS limits are inputs, so one program runs any tuning.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mmwave_env.compiler.program import BatchState, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.epoch_state import blank_track, with_expected_spread
from mmwave_env.engines.track_engine import EpisodeFilter, untuned
from mmwave_env.filters.bank import Bank, settings_of
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.imm import (
    ImmSettings,
    Mixture,
    begin,
    estimate,
    imm_epoch,
    most_probable_memory,
    prediction,
    trusting,
)
from mmwave_env.filters.memory import Memory
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.features import View
from mmwave_env.interface.observation import standardized
from mmwave_env.interface.reward import Reward, TrackingReward, terms_of, total
from mmwave_env.interface.signed import LastEpoch, after_update
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import Site
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.numbers import Array, Index, Number
from mmwave_env.numerics.pytree import flatten, select
from mmwave_env.world.episode import Episode, EpisodeBatch, Incoming


class ImmState(NamedTuple):
    """The state of an IMM between two epochs."""

    incoming: Incoming  # the epoch that was just filtered
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior
    action: Number  # number of the mode whose probability is raised, counted from 1; 0 for none
    settings: ImmSettings  # parameters of the bank
    mixture: Mixture  # belief and probability of every mode
    # x, P: (7,), (28,) combined belief; x_predicted, P_predicted: the same belief before its update
    x: list[Number]
    P: list[Number]
    x_predicted: list[Number]
    P_predicted: list[Number]
    memory: Memory  # memory of the most probable mode
    # reward, error, nees: reward, position error (m) and NEES of the combined belief
    reward: Number
    error: list[Number]
    nees: Number
    signed: list[Number]  # (features,) standardized features for a policy that corrects beliefs


def imm_program(
    pipeline: Pipeline, reward: Reward, acted: bool = False, signed: bool = False
) -> Program[ImmState]:
    """Return the program of an IMM's epoch, shared by pipelines that differ only in tuning.

    Args:
        pipeline: modes and layout.
        reward: function of (belief, truth).
        acted: whether to raise the probability of the mode in the state's field ``action``.
        signed: whether to compute the features of
            :func:`~mmwave_env.interface.signed.after_update`.
    """
    return _program(untuned(pipeline), reward, acted, signed)


@lru_cache(maxsize=32)
def _program(pipeline: Pipeline, reward: Reward, acted: bool, signed: bool) -> Program[ImmState]:
    features = after_update(pipeline, per_mode=True) if signed else []

    def function(w: ImmState) -> ImmState:
        prior = begin(pipeline, w.site.prior_x, w.site.prior_P)
        mixture = select(w.is_first > 0.5, prior, w.mixture)
        coming = w.incoming.epoch(pipeline.layout)
        now = imm_epoch(pipeline, w.settings, mixture, coming, w.site)
        mixture = trusting(now.mixture, w.action, coming.dt) if acted else now.mixture
        x, P = estimate(mixture)
        x_predicted, P_predicted = prediction(now, coming.dt, w.site.hz_per_mps)
        belief = Belief(x, P, pipeline.position_axes)
        truth = w.incoming.truth
        memory = most_probable_memory(mixture)
        before = select(w.is_first > 0.5, w.site.prior_x, w.x)[3:6]
        complete = with_expected_spread(coming, before, w.site)
        last = LastEpoch(complete, 0.0, before, mixture.probability)
        view = View(x, P, memory, [], coming, w.site, None, last)
        return w._replace(
            is_first=0.0,
            mixture=mixture,
            x=x,
            P=pack(P),
            x_predicted=x_predicted,
            P_predicted=P_predicted,
            memory=memory,
            signed=standardized(features, view),
            reward=total(terms_of(reward, belief, truth)),
            error=belief.error(truth),
            nees=belief.nees(truth),
        )

    blank = blank_track(pipeline.layout, 1)
    template = ImmState(
        settings=settings_of(Bank(pipeline.modes), pipeline.layout),
        mixture=begin(pipeline, blank["x"], blank["P"]),
        x_predicted=blank["x"],
        P_predicted=blank["P"],
        reward=0.0,
        signed=[0.0] * len(features),
        **blank,
    )
    return Program(function, template)


def run_imm(
    bank: Bank,
    reward: Reward,
    episodes: EpisodeBatch | Sequence[Episode],
    *names: str,
    planar: bool = False,
    actions: Index | None = None,
) -> dict[str, Array]:
    """Filter complete episodes with an IMM, without an agent, starting from the episodes' priors.

    Args:
        bank: the modes and the parameters of their interaction.
        reward: function of (belief, truth), for comparison with policies.
        episodes: n episodes with the same layout.
        names: parts of :class:`ImmState` to return, such as "reward" or "mixture.probability".
        planar: same as in :class:`~mmwave_env.filters.pipeline.Pipeline`.
        actions: (n, epochs) numbers of the modes whose probability is raised, from 1; 0 for none.

    Returns:
        For each name, an array: (n, epochs) for a part that is a single number, (n, epochs, k) for
        a part of k numbers. Values past the end of an episode are meaningless.
    """
    packed = EpisodeBatch.of(episodes)
    program = imm_program(Pipeline(bank.modes, packed.layout, planar), reward, actions is not None)
    start = program.start.copy()
    (n, epochs, _) = packed.table.shape
    start[flatten(program.index.settings)] = flatten(settings_of(bank, packed.layout))
    rows = fill(blocks_of(start, n), rows_of(program.index.site), packed.site)
    io = StepIO.of(n, epochs, rows_of([program.index.action]), program.rows(names))
    io.inputs[..., 0] = 0 if actions is None else actions
    state = BatchState.of(packed.table, rows)._replace(length=packed.length)
    program.run_on_lanes(state, io)
    return program.by_name(names, io.outputs)


class ImmTracker(EpisodeFilter[ImmState]):
    """N tracks of an IMM, which may continue from one episode to the next.

    Args:
        bank: the modes and the parameters of their interaction.
        layout: which quantity is in which row of a measurement.
        n: number of tracks.
        planar: same as in :class:`~mmwave_env.filters.pipeline.Pipeline`.
        acted: whether :meth:`run` receives actions: the modes whose probability is raised.
        signed: whether to compute the part "signed": features for a policy that corrects beliefs.
    """

    def __init__(
        self,
        bank: Bank,
        layout: Layout,
        n: int,
        planar: bool = False,
        acted: bool = False,
        signed: bool = False,
    ) -> None:
        pipeline = Pipeline(bank.modes, layout, planar)
        program = imm_program(pipeline, TrackingReward(), acted, signed)
        batch = Batch(program, layout, n, rows_of(program.index.action))
        batch.write(program.index.settings, np.array(flatten(settings_of(bank, layout)), float))
        super().__init__(batch)
