"""Filtering of whole tracks with one mode, with given modes, or with a rule that picks modes.

Without an agent, filtering need not stop after every epoch: compiled code runs from the first epoch
of an episode to the last. Process noise is an input, so the same code runs any tuning.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Generic, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mmwave_env.compiler.program import Program, Workspace, rows_of
from mmwave_env.engines.batch import Batch
from mmwave_env.engines.epoch_state import blank_track, initial_belief
from mmwave_env.filters.memory import Memory, memory_after, memory_before
from mmwave_env.filters.modes import Tuning
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import ModeResult
from mmwave_env.interface.policy import Rule
from mmwave_env.models.measurement import Site
from mmwave_env.numerics.numbers import Array, Number
from mmwave_env.numerics.pytree import flatten, tree_at
from mmwave_env.world.episode import Episode, Incoming

NOISES = ("sigma_p", "sigma_v", "sigma_pz", "sigma_vz", "sigma_b_mps", "spread_gain")


class TrackState(NamedTuple):
    """The state of a track between two epochs."""

    incoming: Incoming  # the epoch that the program filters
    site: Site  # anchors, carrier and prior
    is_first: Number  # 1 to start over from the prior
    action: Number  # if there is no rule: number of the mode whose result becomes the belief
    tunings: list[Tuning]  # motion model of every mode
    # x, P: (7,), (28,) belief after the epoch
    x: list[Number]
    P: list[Number]
    # x_predicted, P_predicted: (7,), (28,) belief predicted for the epoch
    x_predicted: list[Number]
    P_predicted: list[Number]
    memory: Memory  # memory of the track; ``memory.mode`` is the mode that ran
    log_likelihood: Number  # same as in :class:`~mmwave_env.filters.update.Posterior`
    error: list[Number]  # (3,) position error, m; NaN if the truth is unknown
    nees: Number  # NEES of the position


def track_epoch(w: TrackState, pipeline: Pipeline, rule: Rule | None) -> TrackState:
    """Compute one epoch of a track."""
    layout = pipeline.layout
    epoch = w.incoming.epoch(pipeline.layout)
    x, P, memory = initial_belief(w, w.x, w.P, w.memory, pipeline)
    number = w.action if rule is None else rule(x, epoch)
    candidates = [
        predict_update(pipeline, mode, x, P, memory, epoch, w.site, tuning)
        for mode, tuning in zip(pipeline.modes, w.tunings, strict=True)
    ]
    chosen: ModeResult = tree_at(number, candidates)
    memory = memory_before(memory, candidates, epoch, layout)
    memory = memory_after(
        layout, number, x, chosen, memory, epoch.dt, epoch.visible, epoch.measured
    )
    belief = pipeline.belief(chosen.x, chosen.P)
    return w._replace(
        is_first=0.0,
        x=chosen.x,
        P=chosen.P,
        x_predicted=chosen.x_predicted,
        P_predicted=chosen.P_predicted,
        memory=memory,
        log_likelihood=chosen.log_likelihood,
        error=belief.error(w.incoming.truth),
        nees=belief.nees(w.incoming.truth),
    )


def program_of(pipeline: Pipeline, rule: Rule | None = None) -> Program[TrackState]:
    """Return the program of a track's epoch, shared by pipelines that differ only in tuning."""
    return _program(untuned(pipeline), rule)


@lru_cache(maxsize=64)
def _program(pipeline: Pipeline, rule: Rule | None) -> Program[TrackState]:
    blank = blank_track(pipeline.layout, len(pipeline.modes))
    template = TrackState(
        tunings=[Tuning(*[0.0] * len(Tuning._fields)) for _ in pipeline.modes],
        x_predicted=blank["x"],
        P_predicted=blank["P"],
        log_likelihood=0.0,
        **blank,
    )
    return Program(partial(track_epoch, pipeline=pipeline, rule=rule), template)


def untuned(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline without tunings, so that modes that differ only in tuning are equal."""
    zeros: dict[str, Any] = dict.fromkeys(NOISES, 0.0) | {"coupling": False}
    modes = []
    for i, mode in enumerate(pipeline.modes):
        kept = ("acceleration_mps2", "turn_rate_radps")
        motion = {name: float(getattr(mode, name) != 0.0) for name in kept}
        modes.append(replace(mode, name=str(i), **zeros | motion))
    return replace(pipeline, modes=tuple(modes))


class EpisodeFilter(Generic[Workspace]):
    """N tracks, filtered by a program, each from the first epoch of its episode to the last.

    Args:
        batch: batch of N environments; the caller sets the rows that :meth:`load` does not set.

    Attributes:
        program: the program of an epoch.
        epochs: number of epochs that :meth:`run` filters: the length of the longest episode.
    """

    def __init__(self, batch: Batch[Workspace]) -> None:
        self.program = batch.program
        self._batch = batch
        self.epochs = 0
        self._end_s = 0.0

    def load(self, episodes: Sequence[Episode], go_on: bool = False) -> None:
        """Load N episodes, to be filtered from their priors.

        Args:
            episodes: one episode per track.
            go_on: whether the episodes continue the tracks just filtered; priors are then ignored.

        Raises:
            ValueError: there are not N episodes, or their layout is not the pipeline's.
        """
        gap_s = float(episodes[0].time_s[0]) - self._end_s if go_on else None
        self._batch.load(episodes, gap_s=gap_s)
        self.epochs = max(len(episode) for episode in episodes)
        self._end_s = float(episodes[0].time_s[-1])

    def load_epoch(self, incoming: Sequence[float], time_s: float) -> None:
        """Load one more epoch of a single track; see :meth:`Batch.load_epoch`."""
        self._batch.load_epoch(incoming, time_s - self._end_s)
        self.epochs = 1
        self._end_s = time_s

    def run(self, *names: str, actions: NDArray[np.integer[Any]] | None = None) -> dict[str, Array]:
        """Filter the loaded episodes once.

        Args:
            names: parts of the program's state to return, such as "x" or "memory.nis".
            actions: (N, epochs) values of the state's part ``action``; None for zeros.

        Returns:
            For each name, an array: (N, epochs), or (N, epochs, k) if the part has k numbers.
        """
        io = self._batch.io(self.epochs, self.program.rows(names))
        io.inputs[..., 0] = 0 if actions is None else actions
        self._batch.advance(io)
        return self.program.by_name(names, io.outputs)


class Tracker(EpisodeFilter[TrackState]):
    """N tracks of a pipeline; in each epoch, the result of one of its modes becomes the belief.

    Args:
        pipeline: the mode, or the modes to choose from.
        n: number of tracks.
        rule: function of (mean (7,) before the epoch, epoch) that returns the number of a mode;
            None if there is only one mode or if :meth:`run` receives the modes' numbers.
        on_floats: whether to run in plain Python (slow, for reference) instead of on SIMD lanes.
    """

    def __init__(
        self, pipeline: Pipeline, n: int, rule: Rule | None = None, on_floats: bool = False
    ) -> None:
        program = program_of(pipeline, rule)
        action = rows_of(program.index.action)
        super().__init__(Batch(program, pipeline.layout, n, action, on_floats))
        self.tune([mode.tuning for mode in pipeline.modes])

    def tune(self, tunings: Sequence[Tuning]) -> None:
        """Set the motion models, one :class:`Tuning` per mode, and start over."""
        row = np.array(flatten(list(tunings)), float)
        self._batch.write(self._batch.at.tunings, row)
        self._batch.restart()
