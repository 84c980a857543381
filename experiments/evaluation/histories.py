"""History of an episode filtered by a contender, epoch by epoch, for pictures."""

import numpy as np

from experiments.evaluation.contenders import Contender
from experiments.evaluation.runner import PLAIN, Scoring, run_contender
from mmwave_env.models.scene import Streets
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import NO_MODE, POSITION_NUMBERS, History, Scenery
from mmwave_env.world.episode import Episode

_KEPT = ("x", "P", "memory.accepted", "memory.rejected", "memory.mode")


def history_of(
    contender: Contender,
    episode: Episode,
    scoring: Scoring = PLAIN,
    streets: Streets | None = None,
) -> History:
    """Return the prior and the contender's results in every epoch.

    Args:
        contender: policy, whose actions are the modes of the history, or IMM, whose most probable
            mode of an epoch gives the mode and the gates.
        episode: episode with its truth.
        scoring: same as in :func:`~experiments.evaluation.runner.run_contender`.
        streets: streets of the episode; None where they are unknown.

    Raises:
        ValueError: the policy fails.
    """
    policy = contender.start(episode.layout, scoring.planar)
    told = run_contender(contender, policy, [episode], scoring, after=_KEPT)
    made = {name: values[0] for name, values in told.items()}
    begun = episode.on_flat_ground() if scoring.planar else episode
    prior_P = begun.prior_covariance[np.tril_indices(3)]
    assert episode.truth_position_m is not None and episode.truth_velocity_mps is not None
    truth = np.hstack([episode.truth_position_m, episode.truth_velocity_mps])
    none = np.zeros_like(made["memory.accepted"][0])
    return History(
        Scenery(episode.name, episode.scene_anchors_m, streets),
        2 if scoring.planar else 3,
        time_s=_after(0.0, episode.time_s - episode.time_s[0]),
        modes=_after(NO_MODE, made.get("mode", made["memory.mode"])).astype(np.int64),
        truth=_after(truth[0], truth),
        estimate=_after(begun.prior_mean, made["x"]),
        P=_after(prior_P, made["P"][:, :POSITION_NUMBERS]),
        nees=_after(np.nan, made["nees"]),
        accepted=_after(none, made["memory.accepted"]) > 0.5,
        rejected=_after(none, made["memory.rejected"]) > 0.5,
    )


def _after(prior: Array | float, epochs: Array) -> Array:
    """Return rows (T + 1, ...): the prior's row, then the rows of the epochs (T, ...)."""
    return np.concatenate([np.asarray(prior)[None], epochs])
