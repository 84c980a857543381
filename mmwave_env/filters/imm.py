"""Interacting multiple models (IMM): all modes run, weighted by how well they explain the data.

The modes are the filters that agents choose from; each has its own gates and scaling of noise.
Sources: Blom and Bar-Shalom 1988; Bar-Shalom, Li and Kirubarajan 2001, Sec. 11.6.6. The functions
``mix``, ``reweigh`` and ``combine`` of :mod:`~mmwave_env.filters.textbook` follow the book's form.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

from mmwave_env.filters.gating import at_degrees
from mmwave_env.filters.memory import Memory, initial_memory, memory_after, memory_before
from mmwave_env.filters.modes import Tuning
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import ModeResult, limited_likelihood
from mmwave_env.models.measurement import Epoch, Site
from mmwave_env.numerics.linalg import dot, minus, plus, product
from mmwave_env.numerics.numbers import (
    Matrix,
    Number,
    Numbers,
    Vector,
    exp,
    maximum,
    minimum,
    where,
)
from mmwave_env.numerics.pytree import indices, select, tree_at

DEFAULT_STAY = 0.95  # probability that the mode does not change within a second
TRUST = 3.0  # if an agent trusts a mode, its probability is multiplied by exp(TRUST) each second
_LEAST = 1e-12  # minimum probability of a mode; a probability of zero could not grow again


class ImmSettings(NamedTuple):
    """The parameters of an IMM as numbers, so that one compiled IMM can run any tuning."""

    transition: Matrix  # (modes, modes) probabilities over one second, [from, to]
    tunings: list[Tuning]  # motion model of every mode
    # (4,) limits of the NIS in :func:`~mmwave_env.filters.update.limited_likelihood`, for groups of
    # measurements with 1, 2, 3 and 4 rows
    limits: Numbers


class Mixture(NamedTuple):
    """The belief of an IMM: a weighted Gaussian for each mode."""

    x: Matrix  # (modes, 7) means
    P: Matrix  # (modes, 28) packed covariances (lower triangles)
    memories: list[Memory]  # past values on which a mode's gates and scaling of noise depend
    probability: Numbers  # (modes,) probability of each mode


def begin(pipeline: Pipeline, x: Vector, P: Vector) -> Mixture:
    """Return a mixture of equally probable modes, which all have the prior x (7,), P (28,)."""
    modes = len(pipeline.modes)
    memories = [initial_memory(pipeline.layout, 1)] * modes
    return Mixture([list(x)] * modes, [list(P)] * modes, memories, [1.0 / modes] * modes)


def mixture_index(pipeline: Pipeline) -> Mixture:
    """Return a :class:`Mixture` that holds the index of each number in a flattened mixture."""
    layout = pipeline.layout
    return indices(begin(pipeline, [0.0] * layout.state_size, [0.0] * layout.triangle))


def stay_matrix(modes: int) -> list[list[float]]:
    """Return transition probabilities: DEFAULT_STAY on the diagonal, equal values elsewhere."""
    if modes == 1:
        return [[1.0]]
    move = (1.0 - DEFAULT_STAY) / (modes - 1)
    return [[DEFAULT_STAY if i == j else move for j in range(modes)] for i in range(modes)]


def moments(
    weights: Sequence[Number], x: Sequence[Vector], P: Sequence[Vector]
) -> tuple[Numbers, Numbers]:
    """Return the mean (7,) and the packed covariance (28,) of a Gaussian mixture."""
    n = len(x[0])
    (mean,) = product([weights], x)
    offset = [minus(xi, mean) for xi in x]
    between = [dot(weights, [d[i] * d[j] for d in offset]) for i in range(n) for j in range(i + 1)]
    return mean, plus(product([weights], P)[0], between)


def mix(mixture: Mixture, transition: Matrix) -> tuple[Numbers, list[tuple[Vector, Vector]]]:
    """Return the predicted mode probabilities and each mode's mixed initial belief."""
    modes = range(len(transition))
    (predicted,) = product([mixture.probability], transition)
    mixed: list[tuple[Vector, Vector]] = []
    for j in modes:
        weights = [transition[i][j] * mixture.probability[i] / predicted[j] for i in modes]
        mixed.append(moments(weights, mixture.x, mixture.P))
    return predicted, mixed


def over_step(transition: Matrix, dt: Number) -> Matrix:
    """Return transition probabilities [from, to] over dt seconds; ``transition`` covers one second.

    If p is the probability of staying in a mode over one second, the probability of leaving it
    within dt seconds is (1 - p) dt. A step of more than 1 s counts as 1 s, so that no probability
    is negative. The first step of an episode, 0 s, also counts as 1 s.
    """
    step = step_weight(dt)
    return [
        [p + (1.0 - step) * (1.0 - p) if i == j else step * p for j, p in enumerate(row)]
        for i, row in enumerate(transition)
    ]


def step_weight(dt: Number) -> Number:
    """Return a step's length in seconds, at most 1; a track's first step, whose dt is 0, gets 1."""
    return where(dt > 0.0, minimum(dt, 1.0), 1.0)


def imm_epoch(
    pipeline: Pipeline, settings: ImmSettings, mixture: Mixture, epoch: Epoch, site: Site
) -> tuple[Mixture, Numbers, list[ModeResult]]:
    """Run an epoch: mix the beliefs, run every mode, weight the modes by their likelihood.

    The tunings in ``settings`` replace the modes' tunings; ``mixture`` is from the previous epoch.

    Returns:
        The mixture after the epoch, the probabilities (modes,) of modes before its measurement, and
        each mode's result, computed from its mixed belief.
    """
    predicted, mixed = mix(mixture, over_step(settings.transition, epoch.dt))
    memories = []
    results = []
    layout = pipeline.layout
    for mode, tuning, memory, (x, P) in zip(
        pipeline.modes, settings.tunings, mixture.memories, mixed, strict=True
    ):
        result = predict_update(pipeline, mode, x, P, memory, epoch, site, tuning)
        before = memory_before(memory, [result], epoch, layout)
        memories.append(memory_after(layout, 0.0, x, result, before, epoch))
        results.append(result)
    limits = [at_degrees(settings.limits, rows) for rows in layout.degrees(epoch.measured)]
    likelihoods = [limited_likelihood(result, limits) for result in results]
    best = reduce(maximum, likelihoods)
    weights = [
        p * exp(likelihood - best) for p, likelihood in zip(predicted, likelihoods, strict=True)
    ]
    means = [result.x for result in results]
    covariances = [result.P for result in results]
    return Mixture(means, covariances, memories, _normalized(weights)), predicted, results


def trusting(mixture: Mixture, mode: Number, dt: Number) -> Mixture:
    """Multiply the probability of a mode in a mixture by a factor, then normalize.

    Modes are counted from 1; ``mode`` 0 leaves the probabilities as they are. The factor is
    exp(TRUST) per second, and ``dt`` is the time since the previous epoch, s (:func:`step_weight`).
    """
    gain = exp(TRUST * step_weight(dt))
    weights = [
        where(abs(mode - (m + 1.0)) < 0.5, gain * p, p) for m, p in enumerate(mixture.probability)
    ]
    probability = select(mode > 0.5, _normalized(weights), mixture.probability)
    return mixture._replace(probability=probability)


def reweighted(mixture: Mixture, log_factors: Vector, dt: Number) -> Mixture:
    """Multiply the modes' probabilities by factors, given as logarithms per second, and normalize.

    ``dt`` is the time since the previous epoch, seconds.
    """
    step = step_weight(dt)
    pairs = zip(mixture.probability, log_factors, strict=True)
    return mixture._replace(probability=_normalized([exp(k * step) * p for p, k in pairs]))


def _normalized(weights: Sequence[Number]) -> Numbers:
    """Return probabilities in proportion to the weights; no probability is zero."""
    held = [maximum(weight, _LEAST) for weight in weights]
    total = sum(held[1:], held[0])
    return [weight / total for weight in held]


def most_probable_memory(mixture: Mixture) -> Memory:
    """Return the memory of the most probable mode; this mode then counts as the last that ran.

    If several modes are equally probable, the first counts.
    """
    number: Number = 0.0
    best = mixture.probability[0]
    for m, probability in enumerate(mixture.probability[1:], start=1):
        number = where(probability > best, float(m), number)
        best = maximum(best, probability)
    memory: Memory = tree_at(number, mixture.memories)
    return memory._replace(mode=number)


def estimate(mixture: Mixture) -> tuple[Numbers, Numbers]:
    """Return the mean (7,) and the packed covariance (28,) of a mixture."""
    return moments(mixture.probability, mixture.x, mixture.P)
