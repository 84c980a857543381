"""Networks of policies, compiled: layers, recurrent units and corrections, track by track.

Every track is computed alone, in single precision and in the same order. So the results of a track
depend neither on the other tracks nor on whether it is live or recorded.
"""

import math
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from mmwave_env.compiler.advance import advance
from mmwave_env.compiler.disk_cache import compiled
from mmwave_env.filters.correction import MOST_LOG_FACTOR, MOST_SHIFT
from mmwave_env.numerics.numbers import Array32, Index
from policies.policy_file import CORRECTIONS, Tensors

# "Trust" is the factor, 0 to 1, by which corrections are scaled.
RANGE_FADE = 2.0  # trust is exp(-2 d) if a feature is d standard deviations outside its range
RECOVERY = np.float32(
    0.1
)  # maximum growth of trust per epoch; slow, as unusual features stay in the memory
# The network is an ensemble, whose members compute different shifts. If the spread of the shifts,
# in corrected standard deviations, is at most SPREAD[0], trust is not reduced; from SPREAD[1] on,
# trust is 0.
SPREAD = (0.5, 1.0)
TANH_LIMIT = 9.0  # tanh of larger numbers is 1 in single precision
_MOST = np.repeat(np.array([MOST_SHIFT, MOST_LOG_FACTOR], np.float32), 3)  # limits of an answer


class Layer(NamedTuple):
    """A linear layer."""

    weight: Array32  # (inputs, outputs)
    bias: Array32  # (outputs,)


class Unit(NamedTuple):
    """A gated recurrent unit (Cho et al. 2014): reset gates, update gates, then candidates."""

    of_input: Layer  # (inputs, 3 units)
    of_state: Layer  # (units, 3 units)


class Sight(NamedTuple):
    """A way in which a network reads observations.

    Attributes:
        columns: (features,) the features' columns in the observation.
        unseen: (features,) values of features whose anchor the scene lacks; else NaN.
        low, high: (features,) ranges of the features in training, to which they are limited.
    """

    columns: Index
    unseen: Array32
    low: Array32
    high: Array32


class Network(NamedTuple):
    """A recurrent network that corrects beliefs."""

    front: Layer
    units: tuple[Unit, ...]  # one, or a second that reads the track backwards
    head: Layer  # of the units' states and the front layer's output
    out: Layer  # see :func:`mean_and_differences`


# tanh(x) = x P(x^2) / Q(x^2): Lambert's continued fraction x / (1 + x^2 / (3 + x^2 / ...)) (DLMF
# 4.39.1), cut after 13 levels; up to TANH_LIMIT, it is exact to 4e-7. Highest power first.
_ABOVE = np.array(
    [1.2648855e-13, 5.179706e-10, 3.2286837e-07, 6.6252585e-05, 0.0052173915, 0.14666666, 1.0],
    np.float32,
)
_BELOW = np.array(
    [1.1510458e-11, 1.5193805e-08, 5.2304677e-06, 0.0006625259, 0.03188406, 0.48, 1.0],
    np.float32,
)


@register_jitable  # type: ignore[untyped-decorator]
def squash(values):  # type: ignore[no-untyped-def]
    """Replace numbers by their hyperbolic tangents."""
    for j in range(len(values)):
        x = min(max(values[j], np.float32(-TANH_LIMIT)), np.float32(TANH_LIMIT))
        square = x * x
        above = _ABOVE[0]
        below = _BELOW[0]
        for k in range(1, len(_ABOVE)):
            above = above * square + _ABOVE[k]
        for k in range(1, len(_BELOW)):
            below = below * square + _BELOW[k]
        values[j] = x * above / below


@register_jitable  # type: ignore[untyped-decorator]
def _add_product(out, x, weight, first):  # type: ignore[no-untyped-def]
    """Add the product of ``x`` and rows of a layer's weight, from row ``first`` on, to ``out``."""
    n = len(x)
    whole = n - n % 4
    for i in range(0, whole, 4):  # four inputs at a time, so that ``out`` is read less often
        a = x[i]
        b = x[i + 1]
        c = x[i + 2]
        d = x[i + 3]
        row = first + i
        for j in range(len(out)):
            of_two = a * weight[row, j] + b * weight[row + 1, j]
            out[j] += of_two + (c * weight[row + 2, j] + d * weight[row + 3, j])
    for i in range(whole, n):
        for j in range(len(out)):
            out[j] += x[i] * weight[first + i, j]


@register_jitable  # type: ignore[untyped-decorator]
def _linear(out, x, layer):  # type: ignore[no-untyped-def]
    """Set ``out`` to a layer's outputs for an input."""
    for j in range(len(out)):
        out[j] = layer.bias[j]
    _add_product(out, x, layer.weight, 0)


@register_jitable  # type: ignore[untyped-decorator]
def _read(observation, sight, features):  # type: ignore[no-untyped-def]
    """Set ``features`` (features,) to an observation's features, limited to their ranges.

    Return how far outside its range the farthest is. A feature that is NaN becomes the lower limit,
    and the result is then NaN.
    """
    beyond = np.float32(0.0)
    for i in range(len(features)):
        value = sight.unseen[i]
        if math.isnan(value):
            value = observation[sight.columns[i]]
        features[i] = sight.low[i]
        if value > sight.low[i]:
            features[i] = min(value, sight.high[i])
        outside = abs(value - features[i])
        if outside > beyond or math.isnan(outside):
            beyond = outside  # once NaN, it stays NaN
    return beyond


@register_jitable  # type: ignore[untyped-decorator]
def _look(observation, sight, layer, front):  # type: ignore[no-untyped-def]
    """Set ``front`` to the first layer's output; return the trust that the features' ranges allow.

    If a feature is NaN, the trust is 0.
    """
    features = np.empty(len(sight.low), np.float32)
    beyond = _read(observation, sight, features)
    _linear(front, features, layer)
    squash(front)
    if math.isnan(beyond):
        return np.float32(0.0)
    return np.float32(math.exp(-RANGE_FADE * beyond))


@register_jitable  # type: ignore[untyped-decorator]
def _remember(front, unit, state):  # type: ignore[no-untyped-def]
    """Replace the state (units,) of a recurrent unit by its next state, given its input."""
    units = len(state)
    # Loops over numbers: numba takes twice as long to compile operations on whole arrays.
    gates = np.empty(3 * units, np.float32)
    past = np.empty(3 * units, np.float32)
    both = np.empty(2 * units, np.float32)
    candidate = np.empty(units, np.float32)
    _linear(gates, front, unit.of_input)
    _linear(past, state, unit.of_state)
    half = np.float32(0.5)
    for j in range(2 * units):
        both[j] = half * (gates[j] + past[j])
    squash(both)  # the logistic function of 2 z is (1 + tanh z) / 2
    for j in range(units):
        reset = half + half * both[j]
        candidate[j] = gates[2 * units + j] + past[2 * units + j] * reset
    squash(candidate)
    for j in range(units):
        update = half + half * both[units + j]
        state[j] = (state[j] - candidate[j]) * update + candidate[j]


@register_jitable  # type: ignore[untyped-decorator]
def _answer(memory, front, trust, network, answer):  # type: ignore[no-untyped-def]
    """Set ``answer`` (CORRECTIONS,) to the scaled correction; return the factor that scaled it."""
    head = np.empty(len(network.head.bias), np.float32)
    _linear(head, memory, network.head)
    _add_product(head, front, network.head.weight, len(memory))
    squash(head)
    out = np.empty(len(network.out.bias), np.float32)
    _linear(out, head, network.out)
    for i in range(CORRECTIONS):
        answer[i] = min(max(out[i], -_MOST[i]), _MOST[i])
    members = (len(out) - CORRECTIONS) // 3
    widest = 0.0
    for direction in range(3):
        variance = 0.0
        for i in range(CORRECTIONS + direction, len(out), 3):
            variance += out[i] * out[i] / members
        widest = max(widest, variance * math.exp(-2.0 * answer[3 + direction]))
    agreed = (SPREAD[1] - math.sqrt(widest)) / (SPREAD[1] - SPREAD[0])
    trusted = np.float32(trust * min(max(agreed, 0.0), 1.0))
    for i in range(CORRECTIONS):
        answer[i] *= trusted
    return trusted


@compiled
def weigh_epoch(begin, end, observations, sight, layers, logits):  # type: ignore[no-untyped-def]
    """Compute a switcher's logits for an epoch of some of n tracks.

    Args:
        begin, end: first track, and the track after the last.
        observations: (n, columns) in single precision.
        sight, layers: how to read them, and the switcher's layers.
        logits: (n, actions) filled with the logits.
    """
    for i in range(begin, end):
        x = np.empty(len(sight.low), np.float32)
        _read(observations[i], sight, x)
        for k in range(len(layers) - 1):
            hidden = np.empty(len(layers[k].bias), np.float32)
            _linear(hidden, x, layers[k])
            squash(hidden)
            x = hidden
        _linear(logits[i], x, layers[-1])


@compiled
def correct_epoch(begin, end, observations, sight, network, state, trust, answers, trusted):  # type: ignore[no-untyped-def]
    """Correct an epoch of some of n tracks.

    Args:
        begin, end: first track, and the track after the last.
        observations: (n, columns) in single precision.
        sight, network: how to read them, and the :class:`Network`.
        state: (n, units) the recurrent unit's states, changed in place.
        trust: (n,) trust of the features' ranges, changed in place.
        answers: (n, CORRECTIONS) filled with the corrections.
        trusted: (n,) filled with the factors that scaled them.
    """
    front = np.empty(len(network.front.bias), np.float32)
    for i in range(begin, end):
        trust[i] = min(_look(observations[i], sight, network.front, front), trust[i] + RECOVERY)
        _remember(front, network.units[0], state[i])
        trusted[i] = _answer(state[i], front, trust[i], network, answers[i])


@compiled
def play_epochs(  # type: ignore[no-untyped-def]
    begin, end, stages, base_sight, layers, sight, network, memory, trust, actions, outputs, trusted
):
    """Play T epochs of n tracks: choose modes by a switcher, and correct beliefs.

    Args:
        begin, end: first block of the tracks, and the block after the last.
        stages: the programs of an epoch (:class:`~mmwave_env.compiler.program.Stages`).
        base_sight, layers: as for :func:`weigh_epoch`.
        sight, network, memory, trust: as for :func:`correct_epoch`.
        actions, outputs, trusted: (n, T), (n, T, k), (n, T) filled with the numbers of the modes,
            the output rows, and the factors that scaled the corrections.
    """
    n, epochs = actions.shape
    io = stages.io
    observations = io.observations[:, 0]
    logits = np.empty((n, len(layers[-1].bias)), np.float32)
    answers = np.empty((n, CORRECTIONS), np.float32)
    factors = np.empty(n, np.float32)
    for t in range(epochs):
        for stage in range(3):  # one call of advance, which takes long to compile
            state = stages.states[min(stage, 1)]
            advance(begin, end, stages.runs[stage], stages.blank, state, io)
            if stage == 0:
                weigh_epoch(0, n, observations, base_sight, layers, logits)
                for i in range(n):
                    actions[i, t] = logits[i].argmax()
                    io.inputs[i, 0, 0] = actions[i, t]
            elif stage == 1:
                correct_epoch(0, n, observations, sight, network, memory, trust, answers, factors)
                for i in range(n):
                    trusted[i, t] = factors[i]
                    for j in range(CORRECTIONS):
                        io.inputs[i, 0, 1 + j] = answers[i, j]
        for i in range(n):
            for j in range(outputs.shape[2]):
                outputs[i, t, j] = io.outputs[i, 0, j]


@compiled
def correct_track(observations, sight, network, answers, trusted):  # type: ignore[no-untyped-def]
    """Correct a track, which is read forwards and backwards.

    Args:
        observations: (T, columns) in single precision.
        sight, network: how to read them, and the :class:`Network`, whose two units have the same
            size.
        answers: (T, CORRECTIONS) filled with the corrections.
        trusted: (T,) filled with the factors that scaled them.
    """
    T = len(observations)
    units = len(network.units[0].of_state.weight)
    front = np.empty((T, len(network.front.bias)), np.float32)
    memory = np.empty((T, 2 * units), np.float32)
    strange = np.empty(T, np.float32)
    for t in range(T):
        strange[t] = _look(observations[t], sight, network.front, front[t])
    trust = strange.copy()
    for direction in range(2):
        state = np.zeros(units, np.float32)
        so_far = np.float32(1.0)
        for step in range(T):
            t = T - 1 - step if direction else step
            _remember(front[t], network.units[direction], state)
            for j in range(units):
                memory[t, direction * units + j] = state[j]
            so_far = min(strange[t], so_far + RECOVERY)
            trust[t] = min(trust[t], so_far)
    for t in range(T):
        trusted[t] = _answer(memory[t], front[t], trust[t], network, answers[t])


def layer_in(tensors: Tensors, name: str, part: str = "") -> Layer:
    """Return the layer ``name`` of a policy file; ``part`` is "_ih" or "_hh" in recurrent units."""
    return Layer(tensors[f"{name}.weight{part}"].T.copy(), tensors[f"{name}.bias{part}"])


def mean_and_differences(weight: Array32, bias: Array32) -> Layer:
    """Return the layer that combines the outputs of an ensemble's members.

    Its outputs are the members' mean, then each member's shift minus the mean shift. The arguments
    are the weight (inputs, outputs) and the bias of the members' layer.
    """
    members = np.concatenate([weight, bias[None]]).reshape(len(weight) + 1, -1, CORRECTIONS)
    mean = members.mean(axis=1)
    differences = (members - mean[:, None])[..., :3]
    rows = np.concatenate([mean, differences.reshape(len(mean), -1)], axis=1)
    return Layer(rows[:-1].copy(), rows[-1].copy())
