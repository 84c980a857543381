"""Interacting multiple models in place of an agent, for one track or many at once."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from mmwave_env.arithmetic import Number
from mmwave_env.episode import Episode
from mmwave_env.estimator.algebra import pack
from mmwave_env.estimator.batch import Batch, Incoming, blank_incoming, blank_site
from mmwave_env.estimator.belief import Belief
from mmwave_env.estimator.imm import (
    Mixture,
    begin,
    estimate,
    imm_epoch,
    restart,
    stay_matrix,
)
from mmwave_env.estimator.pipeline import Pipeline, Site
from mmwave_env.estimator.program import Program
from mmwave_env.reward import Reward


class ImmWorkspace(NamedTuple):
    """Everything an IMM holds between two epochs.

    Attributes:
        incoming: the epoch just filtered.
        site: anchors, carrier and prior.
        fresh: 1 to start over from the prior.
        mixture: belief and probability of every mode.
        x, P: (7,), (28,) the combined belief.
        reward, error, nees: of the epoch, as in :class:`~mmwave_env.engine.Workspace`.
    """

    incoming: Incoming
    site: Site
    fresh: Number
    mixture: Mixture
    x: list[Number]
    P: list[Number]
    reward: Number
    error: list[Number]
    nees: Number


@lru_cache(maxsize=32)
def _imm_program(
    pipeline: Pipeline, transition: tuple[tuple[float, ...], ...], reward: Reward
) -> Program[ImmWorkspace]:
    def function(w: ImmWorkspace) -> ImmWorkspace:
        mixture = restart(w.fresh > 0.5, pipeline, w.site, w.mixture)
        coming = w.incoming.epoch(pipeline.layout)
        mixture = imm_epoch(pipeline, transition, mixture, coming, w.site)
        x, P = estimate(mixture)
        belief = Belief(x, P, pipeline.position_axes)
        truth = w.incoming.truth
        return w._replace(
            fresh=0.0,
            mixture=mixture,
            x=x,
            P=pack(P),
            reward=reward(belief, truth),
            error=belief.error(truth),
            nees=belief.nees(truth),
        )

    incoming, site = blank_incoming(pipeline.layout), blank_site(pipeline.layout)
    mixture = begin(pipeline, site.prior_x, site.prior_P)
    template = ImmWorkspace(
        incoming, site, 1.0, mixture, site.prior_x, site.prior_P, 0.0, [0.0] * 3, 0.0
    )
    return Program(function, template)


class ImmEngine:
    """N interacting-multiple-model estimators in step; no actions, it weighs the modes itself.

    Args:
        pipeline: modes and layout.
        n: number of estimators.
        reward: function of (belief, truth), for comparison with policies.
        transition: (modes, modes) transition probabilities, rows sum to 1; None for the
            default, which stays with probability 0.95.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        n: int,
        reward: Reward,
        transition: tuple[tuple[float, ...], ...] | None = None,
    ) -> None:
        transition = transition or stay_matrix(len(pipeline.modes))
        self.pipeline = pipeline
        self._batch = Batch(_imm_program(pipeline, transition, reward), pipeline.layout, n)
        self.at, self.read = self._batch.at, self._batch.read

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Start over with one episode each and filter the first epoch."""
        self._batch.begin(episodes)

    def step(self) -> None:
        """Filter the next epoch."""
        self._batch.advance()
