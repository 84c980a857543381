"""Errors that all links of a log share: azimuths turned, ranges too long, an anchor off its place.

Links agree about such an error, so gates and NIS show nothing. But the error changes the
innovations of the whole track (:mod:`~mmwave_env.localization.sensitivities`). An error that may be
present is refined by undoing it and running the filter again. What counts is the gain of the
corrected log: by how much the sum of Huber's function of the innovations decreases.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mmwave_env.filters.modes import Mode
from mmwave_env.localization.readings import Reading
from mmwave_env.localization.sensitivities import innovations, rho, scan
from mmwave_env.localization.suspects import Suspect, suspects
from mmwave_env.numerics.numbers import Array

_RUNS = 3  # maximum number of runs of the filter that refine an error
_SETTLED = 0.1  # an error is refined if its last change was less, in standard deviations
_MOST_DEVIATIONS = 3.0  # largest size of an error, in standard deviations of its prior
_COST = 3.0  # gain that each parameter must bring
_ALIKE = 6.0  # errors whose gains differ by less can't be told apart
# A corrected track with more than this share of epochs with so large a NIS / dof is lost.
_LOST_NIS = 50.0
_LOST_SHARE = 0.1
_MOST_ERRORS = 3


class SharedError(NamedTuple):
    """An error that a log shows."""

    name: str  # name of the suspect
    theta: Array  # (p,) its size, in m, degrees or percent
    sigma: Array  # (p,) standard deviations
    rivals: list[str]  # names of other suspects that explain the log about as well


def _refined(
    reading: Reading, mode: Mode, suspect: Suspect, theta: Array, runs: int = _RUNS
) -> tuple[Array, Array]:
    """Return an error's theta (p,) and standard deviations (p,), refined by running the filter."""
    most = _MOST_DEVIATIONS * suspect.deviation
    theta = np.clip(theta, -most, most)
    for _ in range(runs):
        corrected = reading.without(suspect.undo(reading, theta))
        rest = scan(corrected, mode, {suspect.name: suspect})[1][suspect.name]
        theta = np.clip(theta + rest.theta, -most, most)
        if np.linalg.norm(rest.theta / rest.sigma) < _SETTLED:
            break
    return theta, rest.sigma


def without_errors(
    reading: Reading, errors: Sequence[SharedError], among: Mapping[str, Suspect]
) -> Reading:
    """Return a reading in which errors are undone, one after the other."""
    for error in errors:
        reading = reading.without(among[error.name].undo(reading, error.theta))
    return reading


def shared_errors(reading: Reading, mode: Mode) -> list[SharedError]:
    """Return the errors of a reading that all links share, or that one anchor has.

    The first error is the most likely one. ``mode`` must have no safeguards, such as gates: they
    would reject what shows the error. The first epoch must determine a position.
    """
    among = suspects(reading)
    errors: list[SharedError] = []
    corrected = reading
    while len(errors) < _MOST_ERRORS and among:
        error = _likeliest(corrected, mode, among)
        if error is None:
            break
        errors.append(error)
        if len(errors) > 1:
            errors = _again(reading, mode, errors, among)
        corrected = without_errors(reading, errors, among)
    return errors


def _likeliest(reading: Reading, mode: Mode, among: Mapping[str, Suspect]) -> SharedError | None:
    """Return the error whose correction gains most; None if none gains enough."""
    w, fits = scan(reading, mode, among)
    gains = {}
    errors = {}
    for name, rough in fits.items():
        suspect = among[name]
        size = np.linalg.norm(rough.theta)
        if rough.wald < suspect.sure or rough.gain < suspect.gain or size < suspect.least:
            continue
        theta, sigma = _refined(reading, mode, suspect, rough.theta)
        corrected = reading.without(suspect.undo(reading, theta))
        (new,), measured = innovations([corrected], mode)
        lost = (new**2).sum(axis=1) > _LOST_NIS * np.maximum(measured.sum(axis=1), 1)
        if lost.mean() <= _LOST_SHARE:
            cost = suspect.cost + _COST * suspect.parameters
            gains[name] = float((rho(w) - rho(new)).sum()) - cost
            errors[name] = SharedError(name, theta, suspect.caution * sigma, [])
    best = max(gains, key=lambda name: gains[name], default="")
    if not best or gains[best] < 0.5 * among[best].gain:
        return None
    rivals = [
        name
        for name, gain in gains.items()
        if name != best and not among[name].cost and gain > gains[best] - _ALIKE
    ]
    return errors[best]._replace(rivals=rivals)


def _again(
    reading: Reading, mode: Mode, errors: list[SharedError], among: Mapping[str, Suspect]
) -> list[SharedError]:
    """Return errors whose sizes are refined in turn, twice, with the others undone."""
    errors = errors.copy()
    for k in [*range(len(errors))] * 2:
        error = errors[k]
        rest = without_errors(reading, errors[:k] + errors[k + 1 :], among)
        suspect = among[error.name]
        theta, sigma = _refined(rest, mode, suspect, error.theta, 1)
        errors[k] = error._replace(theta=theta, sigma=suspect.caution * sigma)
    return errors
