"""The loop of a policy: it acts, the filters step, and it may correct their beliefs."""

from typing import NamedTuple

import numpy as np

from mmwave_env.compiler.program import NO_ROWS
from mmwave_env.engines.engine import Engine
from mmwave_env.interface.policy import Correction, Policy
from mmwave_env.numerics.numbers import Array, Array32, Index


class Played(NamedTuple):
    """The record of T epochs of n tracks.

    Attributes:
        actions: (n, T) the policy's actions.
        outputs: (n, T, k) the rows that the caller asked for, after every epoch.
        features: (n, T, c) the columns of observations that the caller asked for, after every
            epoch.
        corrections: corrections (n, T, 3) of the beliefs; None if the policy does not correct.
    """

    actions: Index
    outputs: Array
    features: Array32
    corrections: Correction | None


def play(
    engine: Engine,
    policy: Policy,
    epochs: int,
    output_rows: Index = NO_ROWS,
    columns: Index = NO_ROWS,
) -> Played:
    """Play the next epochs of an engine's tracks, which have just begun.

    Args:
        engine: engine that has loaded the tracks and run their first epoch (``reset``).
        policy: policy whose features have been looked up in ``engine.observation``.
        epochs: number of epochs.
        output_rows: indices of the rows to record, as in :meth:`Engine.step`.
        columns: indices of the columns of observations to record.
    """
    n = engine.batch.n
    actions = np.empty((n, epochs), np.int64)
    outputs = np.empty((n, epochs, len(output_rows)))
    features = np.empty((n, epochs, len(columns)), np.float32)
    corrections = []
    policy.reset(np.ones(n, bool))
    observations = engine.observations()
    for t in range(epochs):
        actions[:, t] = policy.act(observations)
        observations, outputs[:, t] = engine.step(actions[:, t], output_rows)
        features[:, t] = observations[:, columns]
        if policy.corrects:
            corrections.append(policy.correct(observations))
    return Played(actions, outputs, features, stacked(corrections))


def stacked(corrections: list[Correction | None]) -> Correction | None:
    """Return the corrections (n, 3) of T epochs as arrays (n, T, 3); None if there are none."""
    known = [correction for correction in corrections if correction is not None]
    if not known:
        return None
    shift, log_factor, trusted = zip(*known, strict=True)
    return Correction(np.stack(shift, 1), np.stack(log_factor, 1), np.stack(trusted, 1))
