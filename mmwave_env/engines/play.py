"""The loop of a policy: the modes run, it acts, the belief follows, and it may be corrected."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.compiler.program import NO_ROWS
from mmwave_env.engines.engine import Engine
from mmwave_env.interface.actions import CORRECTION, WEIGHTS
from mmwave_env.interface.policy import Policy
from mmwave_env.numerics.numbers import Array, Array32, Index


class Played(NamedTuple):
    """The record of T epochs of n tracks.

    Attributes:
        actions: (n, T) the policy's actions; of weights, the mode that is trusted most.
        outputs: for each name that the caller asked for, (n, T), or (n, T, k) if the part has k
            numbers, after every epoch.
        features: (n, T, c) the columns of observations that the caller asked for, after every
            epoch's update.
        trusted: (n, T) factors that scaled the corrections; NaN if the policy does not correct.
    """

    actions: Index
    outputs: dict[str, Array]
    features: Array32
    trusted: Array32


def play(
    engine: Engine,
    policy: Policy,
    epochs: int,
    names: Sequence[str] = (),
    columns: Index = NO_ROWS,
    scored: bool = True,
) -> Played:
    """Play the next epochs of an engine's tracks; each epoch is filtered once.

    Args:
        engine: engine that has loaded the tracks. Its actions are of the policy's kind; if columns
            that describe the belief after its update are recorded, they are corrections.
        policy: policy whose features have been looked up in ``engine.observation``, and that has
            been reset where tracks begin.
        epochs: number of epochs.
        names: parts of the :class:`EpochState` to record, such as "x" or "memory.nis".
        columns: indices of the columns of observations to record.
        scored: whether to score the beliefs against the truth.
    """
    n = engine.n
    output_rows = engine.program.rows(names)
    actions = np.empty((n, epochs), np.int64)
    outputs = np.empty((n, epochs, len(output_rows)))
    features = np.empty((n, epochs, len(columns)), np.float32)
    trusted = np.full((n, epochs), np.nan, np.float32)
    for t in range(epochs):
        acted = policy.act(engine.filter())
        actions[:, t] = 1 + acted.argmax(axis=1) if policy.action == WEIGHTS else acted
        if policy.action != CORRECTION:
            observations, outputs[:, t] = engine.decide(acted, output_rows, scored)
            features[:, t] = observations[:, columns]
            continue
        observations, _ = engine.decide(acted)  # the corrected belief is scored instead
        features[:, t] = observations[:, columns]
        correction = policy.correct(observations)
        assert correction is not None
        numbers = np.concatenate([correction.shift, correction.log_factor], axis=1)
        outputs[:, t] = engine.correct(numbers, output_rows)
        trusted[:, t] = correction.trusted
    parts = engine.program.by_name(names, outputs)
    return Played(actions, parts, features, trusted)
