"""Interacting multiple models in place of an agent, over whole episodes in one kernel call.

No action steers an IMM, so nothing has to stop between two epochs. Whatever may be tuned
(transition probabilities, process noise, how much an outlier says) is part of its data, so
that one compiled program runs any of it.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import BatchState, Program, StepIO, rows_of
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.track_engine import untuned
from mmwave_env.episodes.episode import Episode, EpisodeBatch, Incoming, blank_incoming
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.imm import Mixture, begin, estimate, imm_epoch, stay_matrix
from mmwave_env.filters.modes import Tuning
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.models.epoch import Site, blank_site
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.numerics.linalg import pack
from mmwave_env.numerics.numbers import Number
from mmwave_env.numerics.pytree import flatten, select
from mmwave_env.reward import Reward


class ImmState(NamedTuple):
    """Everything an IMM holds between two epochs."""

    incoming: Incoming  # the epoch just filtered
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior
    transition: list[list[Number]]  # (modes, modes) transition probabilities (from, to)
    tunings: list[Tuning]  # process noise of every mode
    limits: list[Number]  # (groups,) NIS that counts at most in a likelihood
    mixture: Mixture  # belief and probability of every mode
    # x, P: (7,), (28,) the combined belief
    x: list[Number]
    P: list[Number]
    # reward, error, nees: of the epoch, as in :class:`~mmwave_env.engines.env_engine.Workspace`
    reward: Number
    error: list[Number]
    nees: Number


@lru_cache(maxsize=32)
def _program(pipeline: Pipeline, reward: Reward) -> Program[ImmState]:
    def function(w: ImmState) -> ImmState:
        prior = begin(pipeline, w.site.prior_x, w.site.prior_P)
        mixture = select(w.is_first > 0.5, prior, w.mixture)
        coming = w.incoming.epoch(pipeline.layout)
        mixture = imm_epoch(pipeline, w.transition, w.tunings, w.limits, mixture, coming, w.site)
        x, P = estimate(mixture)
        belief = Belief(x, P, pipeline.position_axes)
        truth = w.incoming.truth
        return w._replace(
            is_first=0.0,
            mixture=mixture,
            x=x,
            P=pack(P),
            reward=reward(belief, truth),
            error=belief.error(truth),
            nees=belief.nees(truth),
        )

    site, modes = blank_site(pipeline.layout), pipeline.modes
    template = ImmState(
        incoming=blank_incoming(pipeline.layout),
        site=site,
        is_first=1.0,
        transition=[[0.0] * len(modes) for _ in modes],
        tunings=[mode.tuning for mode in modes],
        limits=[0.0] * len(pipeline.layout.groups),
        mixture=begin(pipeline, site.prior_x, site.prior_P),
        x=site.prior_x,
        P=site.prior_P,
        reward=0.0,
        error=[0.0] * 3,
        nees=0.0,
    )
    return Program(function, template)


def transition_from(transition: ArrayLike | None, modes: int) -> Array:
    """Transition probabilities (from, to) as an array (modes, modes).

    Args:
        transition: such a matrix; None to stay with probability 0.95.
        modes: how many there are.

    Raises:
        ValueError: another shape, rows that are no probabilities, or a mode that none leads to.
    """
    found = np.array(stay_matrix(modes) if transition is None else transition, float)
    if (
        found.shape != (modes, modes)
        or not (found >= 0.0).all()
        or not np.allclose(found.sum(axis=1), 1.0, rtol=0.0, atol=1e-6)
        or not found.any(axis=0).all()
    ):
        raise ValueError(
            f"transition: found {found.tolist()}, expected {modes} rows of {modes} probabilities "
            "that sum to 1, and none of the modes out of reach"
        )
    return found


class ImmEngine:
    """Interacting multiple models over the modes of a pipeline; it weighs them itself.

    Args:
        pipeline: modes and layout.
        reward: function of (belief, truth), for comparison with policies.
        transition: (modes, modes) transition probabilities (from, to); None for the default,
            which stays with probability 0.95.
        nis_quantile: chi-square quantile up to which the NIS of a link counts in a likelihood;
            1 for all of it, as in the textbook.

    Raises:
        ValueError: a quantile outside (0, 1], or no transition (:func:`transition_from`).
    """

    def __init__(
        self,
        pipeline: Pipeline,
        reward: Reward,
        transition: ArrayLike | None = None,
        nis_quantile: float = 1.0,
    ) -> None:
        if not 0.0 < nis_quantile <= 1.0:
            raise ValueError(f"nis_quantile: found {nis_quantile}, expected a quantile in (0, 1]")
        self.pipeline = pipeline
        self.transition = transition_from(transition, len(pipeline.modes))
        self._program = _program(untuned(pipeline), reward)
        index, self._start = self._program.index, self._program.start.copy()
        self._start[flatten(index.transition)] = self.transition.ravel()
        self._start[flatten(index.tunings)] = flatten([mode.tuning for mode in pipeline.modes])
        rows = [group.stop - group.start for group in pipeline.layout.groups]
        self._start[flatten(index.limits)] = chdtri(rows, 1.0 - nis_quantile)

    def run(self, episodes: EpisodeBatch | Sequence[Episode], *names: str) -> dict[str, Array]:
        """Filter episodes from their priors to their ends.

        Args:
            episodes: N of them.
            names: parts of :class:`ImmState` to return, such as "reward" or
                "mixture.probability".

        Returns:
            Per name (n, epochs) of a single number, else (n, epochs, numbers); what is past the
            end of an episode means nothing.

        Raises:
            ValueError: another layout than the pipeline's.
        """
        packed = episodes if isinstance(episodes, EpisodeBatch) else EpisodeBatch.of(episodes)
        if packed.layout != self.pipeline.layout:
            raise ValueError(
                f"layout of episode {packed.names[0]!r}: found {packed.layout}, expected "
                f"{self.pipeline.layout}"
            )
        return self._filter(packed.table, packed.site, packed.length, names)

    def rewards(self, batch: Batch[Any], places: Index) -> Array:
        """What it would earn on episodes that are loaded in a batch, which stays as it is.

        Args:
            batch: what holds the episodes.
            places: (n,) where.

        Returns:
            Rewards (n, epochs); what is past the end of an episode means nothing.
        """
        length = batch.state.length[places]
        table = batch.state.table[places, : length.max()]
        return self._filter(table, batch.sites(places), length, ["reward"])["reward"]

    def _filter(
        self, table: Array, site: Array, length: Index, names: Sequence[str]
    ) -> dict[str, Array]:
        """Filter tables (n, epochs, columns) at sites (n, numbers)."""
        n, epochs, _ = table.shape
        program = self._program
        rows = np.tile(self._start[None, :, None], (-(-n // WIDTH), 1, WIDTH))
        block, lane = np.divmod(np.arange(n), WIDTH)
        rows[block[:, None], flatten(program.index.site), lane[:, None]] = site
        io = StepIO.of(n, epochs, output_rows=rows_of(program.parts(names)))
        program.run_on_lanes(BatchState.of(table, rows)._replace(length=length), io)
        return program.by_name(names, io.outputs)
