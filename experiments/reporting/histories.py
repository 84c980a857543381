"""Histories of contenders, epoch by epoch, for pictures and the player."""

from collections.abc import Iterator, Sequence

import numpy as np

from experiments.evaluation.contenders import Contender, draw_episodes, keys_for
from experiments.evaluation.runner import PLAIN, Scoring, run_contender
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array
from mmwave_env.rendering.history import NO_MODE, POSITION_NUMBERS, History
from mmwave_env.task import Task
from mmwave_env.world.episode import Episode

_KEPT = ("x", "P", "memory.accepted", "memory.rejected", "memory.mode")


def history_of(
    contender: Contender, episode: Episode, scoring: Scoring = PLAIN, scene: Scene | None = None
) -> History:
    """Run a contender on an episode with a true track; return its history, from the prior on.

    For a policy, the modes in the history are its actions. For an IMM, they are the most probable
    modes, and the history has the groups of measurements that these modes accepted and rejected.

    Raises:
        ValueError: the policy fails.
    """
    results = run_contender(contender, [episode], scoring, after=_KEPT)
    made = {name: values[0] for name, values in results.items()}
    begun = episode.on_flat_ground() if scoring.planar else episode
    prior_P = begun.prior_covariance[np.tril_indices(3)]
    assert episode.truth_position_m is not None and episode.truth_velocity_mps is not None
    truth = np.hstack([episode.truth_position_m, episode.truth_velocity_mps])
    none = np.zeros_like(made["memory.accepted"][0])
    return History(
        episode.name,
        episode.scene_anchors_m,
        scene,
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


def histories_of(
    task: Task, seeds: Sequence[int], contenders: Sequence[Contender]
) -> Iterator[tuple[Episode, list[History]]]:
    """Draw an episode for each seed; yield it with the history of every contender."""
    scoring = Scoring.of(task)
    for seed in seeds:
        keys = keys_for(task.source, [seed])
        scene = task.scene_of(0 if keys is None else int(keys[0]))
        (episode,) = draw_episodes(task.source, [seed])
        yield episode, [history_of(c, episode, scoring, scene) for c in contenders]


def _after(prior: Array | float, epochs: Array) -> Array:
    """Return rows (T + 1, ...): the prior's row, then the rows of the epochs (T, ...)."""
    return np.concatenate([np.asarray(prior)[None], epochs])
