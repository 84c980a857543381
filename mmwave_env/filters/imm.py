"""Interacting multiple models: all modes at once, weighed by how well they explain the data.

Blom and Bar-Shalom 1988; Bar-Shalom, Li and Kirubarajan 2001, Sec. 11.6.6. The modes are
the same pipelines that an agent switches between, each with its own gates and scaling. With
matrices, as there, it stands in ``tests/filters/test_imm.py`` (``textbook_imm``).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.mode_result import limited_likelihood
from mmwave_env.filters.modes import Tuning
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.models.epoch import Epoch, Site
from mmwave_env.models.measurement import STATE_SIZE
from mmwave_env.numerics.linalg import dot, unpack
from mmwave_env.numerics.numbers import Matrix, Number, Vector, exp, maximum

DEFAULT_STAY = 0.95  # probability of a mode to stay from one epoch to the next
_LEAST = 1e-12  # keeps the probability of a mode off zero, from which it could not return


class ModeTrack(NamedTuple):
    """One mode's filter within the IMM."""

    # x, P: (7,), (28,) its belief
    x: list[Number]
    P: list[Number]
    memory: Memory  # of its gates and scaling


class Mixture(NamedTuple):
    """The IMM's belief."""

    tracks: list[ModeTrack]  # one per mode
    probability: list[Number]  # (modes,) of each mode


def single(pipeline: Pipeline) -> list[Pipeline]:
    """A pipeline of one mode for each mode."""
    return [replace(pipeline, modes=(mode,)) for mode in pipeline.modes]


def begin(pipeline: Pipeline, x: Vector, P: Vector) -> Mixture:
    """All modes at the prior (7,), (28,), equally probable."""
    tracks = [
        ModeTrack(list(x), list(P), initial_memory(one.layout, 1)) for one in single(pipeline)
    ]
    return Mixture(tracks, [1.0 / len(tracks)] * len(tracks))


def stay_matrix(modes: int, stay: float = DEFAULT_STAY) -> tuple[tuple[float, ...], ...]:
    """Transition probabilities (from, to): stay, or move to any other mode alike."""
    if not 0.0 < stay <= 1.0:
        raise ValueError(f"stay: found {stay}, expected a probability in (0, 1]")
    if modes == 1:
        return ((1.0,),)
    move = (1.0 - stay) / (modes - 1)
    return tuple(tuple(stay if i == j else move for j in range(modes)) for i in range(modes))


def moments(
    weights: Sequence[Number], x: Sequence[Vector], P: Sequence[Vector]
) -> tuple[list[Number], list[Number]]:
    """Mean (7,) and packed covariance (28,) of a Gaussian mixture."""
    mean = [dot(weights, [xi[i] for xi in x]) for i in range(STATE_SIZE)]
    offset = [[xi[i] - mean[i] for i in range(STATE_SIZE)] for xi in x]
    spread = [
        dot(weights, [d[i] * d[j] for d in offset]) for i in range(STATE_SIZE) for j in range(i + 1)
    ]
    return mean, [dot(weights, [Pi[k] for Pi in P]) + value for k, value in enumerate(spread)]


def mix(mixture: Mixture, transition: Matrix) -> tuple[Vector, list[tuple[Vector, Vector]]]:
    """Predicted mode probabilities, and each mode's mixed initial belief."""
    modes = range(len(mixture.tracks))
    predicted = [dot([row[j] for row in transition], mixture.probability) for j in modes]
    x = [track.x for track in mixture.tracks]
    P = [track.P for track in mixture.tracks]
    mixed: list[tuple[Vector, Vector]] = []
    for j in modes:
        weights = [transition[i][j] * mixture.probability[i] / predicted[j] for i in modes]
        mixed.append(moments(weights, x, P))
    return predicted, mixed


def imm_epoch(
    pipeline: Pipeline,
    transition: Matrix,
    tunings: Sequence[Tuning],
    limits: Vector,
    mixture: Mixture,
    epoch: Epoch,
    site: Site,
) -> Mixture:
    """The mixture after one more epoch: mix, run every mode, weigh them by their likelihood.

    Args:
        pipeline, epoch, site: as of :func:`~mmwave_env.filters.pipeline.predict_update`.
        transition: (modes, modes) probabilities (from, to).
        tunings: process noise, in place of the modes' own.
        limits: (groups,) as in :func:`limited_likelihood`; infinite in the textbook.
        mixture: after the epoch before.
    """
    predicted, mixed = mix(mixture, transition)
    tracks, likelihoods = [], []
    for one, tuning, track, (x, P) in zip(
        single(pipeline), tunings, mixture.tracks, mixed, strict=True
    ):
        candidate = predict_update(one, one.modes[0], x, P, track.memory, epoch, site, tuning)
        memory = memory_before(track.memory, [candidate], epoch, pipeline.layout)
        memory = memory_after(one.layout, 0.0, x, candidate, memory, epoch.dt, epoch.visible)
        tracks.append(ModeTrack(candidate.x, candidate.P, memory))
        likelihoods.append(limited_likelihood(candidate, limits))
    best = likelihoods[0]
    for likelihood in likelihoods[1:]:
        best = maximum(best, likelihood)
    weights = [
        maximum(p * exp(likelihood - best), _LEAST)
        for p, likelihood in zip(predicted, likelihoods, strict=True)
    ]
    total = dot(weights, [1.0] * len(weights))
    return Mixture(tracks, [w / total for w in weights])


def estimate(mixture: Mixture) -> tuple[list[Number], list[list[Number]]]:
    """Mean (7,) and covariance (7, 7) of the whole mixture."""
    x, P = moments(
        mixture.probability,
        [track.x for track in mixture.tracks],
        [track.P for track in mixture.tracks],
    )
    return x, unpack(P)
