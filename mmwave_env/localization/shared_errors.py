"""Errors that all links of a log share: azimuths turned, ranges too long, an anchor off its place.

Links agree about such an error, so gates and NIS show nothing. But the error changes the
innovations of the whole track (:mod:`~mmwave_env.localization.sensitivities`). An error that may be
present is refined by undoing it and running the filter again. What counts is the gain of the
corrected log: by how much the sum of Huber's function of the innovations decreases.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.filters.modes import Mode
from mmwave_env.localization.readings import Mistake, Reading, values_of
from mmwave_env.localization.segments import stretches
from mmwave_env.localization.sensitivities import FilterRun, innovations, rho, scan
from mmwave_env.localization.starts import Start
from mmwave_env.localization.suspects import Suspect, suspects
from mmwave_env.logs.log import Log
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene, scene_json
from mmwave_env.numerics.numbers import Array, Mask

SCANNED_EPOCHS = 1000
LEAST_EPOCHS = 100
LEAST_S = 10.0
ENOUGH_S = 100.0  # in shorter logs, an error must be more certain, because blockages look like one
LONGEST_STEP_S = 2.0
_RUNS = 3  # maximum number of runs of the filter that refine an error
_SETTLED = 0.1  # an error is refined if its last change was less, in standard deviations
_MOST_DEVIATIONS = 3.0  # largest size of an error, in standard deviations of its prior
_COST = 3.0  # gain that each parameter must bring
_TRIED = 6  # suspects, those with the largest gains, that are refined if one of all is certain
_ALIKE = 6.0  # errors whose gains differ by less can't be told apart
_MOST_RIVALS = 3  # that are named
# A corrected track with more than this share of epochs with so large a NIS / dof is lost.
_LOST_NIS = 50.0
_LOST_SHARE = 0.1
_MOST_ROUNDS = 3
_STRICTEST = 5.0  # largest factor by which the limits are higher in shorter logs
_CERTAIN = 3.0  # standard deviations by which a part of an error differs from 0
_DIGITS = 3  # decimals of sizes
_NANOSECOND_M = 1e-9 * SPEED_OF_LIGHT


class SharedError(NamedTuple):
    """An error that a log shows."""

    suspect: Suspect
    theta: Array  # (p,) its size, in the unit of the suspect
    sigma: Array  # (p,) standard deviations
    rivals: Sequence[str] = ()  # names of other suspects that explain the log about as well

    def __str__(self) -> str:
        others = f" (or {', or '.join(self.rivals)})" if self.rivals else ""
        return f"{self.suspect.words(self.theta, self.sigma)}{others}"

    def undone(self, reading: Reading) -> Mistake:
        """Return what undoes the error in a reading, with words and cure."""
        mistake = self.suspect.undo(reading, self.theta)
        size = float(self.theta[-1])
        cure = self.suspect.cure.format(size, size / _NANOSECOND_M)
        change = _scene_change(reading.scene, mistake.scene or reading.scene)
        joint = ", " if cure.startswith("or") else " and "
        return mistake._replace(words=str(self), cure=joint.join(filter(None, [change, cure])))


def _scene_change(old: Scene, new: Scene) -> str:
    """Return what to write into the file of a scene; "" if nothing changes."""
    before = scene_json(old)
    after = scene_json(new)
    keys = [key for key, value in after.items() if before.get(key) != value]
    written = [f"{json.dumps(key)}: {json.dumps(_rounded(after[key]))}" for key in keys]
    instead = [key for key in before if key not in after]
    if not written:
        return ""
    places = f", instead of {', '.join(instead)}," if instead else ""
    return f"write {', '.join(written)}{places} into the scene's file"


def _rounded(value: Any) -> Any:
    """Return numbers, or a list of lists of numbers, rounded for people."""
    if isinstance(value, float):
        return round(value, _DIGITS)
    return [_rounded(each) for each in value] if isinstance(value, list | tuple) else value


def scanned(log: Log, scene: Scene, radio: Radio) -> tuple[Log, Start] | None:
    """Return the epochs of a log to look for shared errors in, and their start.

    They are the first 1,000 epochs, at least 100, of the first track of at least 10 s. Of a track
    with more epochs in 100 s, epochs in between are left out. The result is None if there is no
    such track, or if its steps are longer than 2 s.
    """
    if log.layout.odometry:
        log = _without_odometry(log)
    for epochs, start in stretches(log, scene, radio):
        part = log.part(epochs)
        step_s = float(np.median(np.diff(part.time_s))) if len(part) > 1 else np.inf
        stride = max(1, int(np.ceil(ENOUGH_S / (SCANNED_EPOCHS * step_s) - 1e-9)))
        part = part.part(slice(0, SCANNED_EPOCHS * stride, stride))
        enough_s = len(part) * step_s * stride >= LEAST_S
        if len(part) >= LEAST_EPOCHS and enough_s and step_s * stride <= LONGEST_STEP_S:
            return part, start._replace(spent=start.spent[::stride])
    return None


def _without_odometry(log: Log) -> Log:
    """Return a log without speed and heading, which may be in another frame than the links."""
    layout = replace(log.layout, odometry=False)
    groups = len(layout.groups)
    return replace(
        log,
        layout=layout,
        measurement=log.measurement[:, : layout.size],
        sigma=log.sigma[:, : layout.size],
        visible=log.visible[:, :groups],
        incomplete=log.incomplete[:, :groups],
    )


def find_shared_errors(
    log: Log, scene: Scene, radio: Radio, mode: Mode, rounds: int = _MOST_ROUNDS
) -> list[SharedError]:
    """Return the errors of a log that all links share, or that one anchor has.

    The first error is the most likely one. The list is empty if the log is too short
    (:func:`scanned`). Of ``mode``, tuning and algorithm are used, but not its safeguards, such as
    gates: they would reject what shows the error. A round looks for one more error.

    Raises:
        ValueError: no epoch determines a position with which a track could begin.
    """
    part = scanned(log, scene, radio)
    if part is None:
        return []
    epochs, start = part
    reading = Reading(epochs, scene, radio)
    return shared_errors(reading, FilterRun.of(mode, reading, start), rounds)


def shared_errors(
    reading: Reading, run: FilterRun, rounds: int = _MOST_ROUNDS
) -> list[SharedError]:
    """Return the errors of a reading, the most likely one first, without regard to its length."""
    among = suspects(reading)
    errors: list[SharedError] = []
    corrected = reading
    for _ in range(rounds):
        error = _likeliest(corrected, run, among)
        if error is None:
            break
        errors += _parts(error, among)
        if len(errors) > 1:
            errors = _again(reading, run, errors)
        corrected = without_errors(reading, errors)
    return [error._replace(theta=error.theta.round(_DIGITS)) for error in errors]


def without_errors(reading: Reading, errors: Sequence[SharedError]) -> Reading:
    """Return a reading in which errors are undone, one after the other."""
    for error in errors:
        reading = reading.without(error.undone(reading))
    return reading


def _likeliest(
    reading: Reading, run: FilterRun, among: Mapping[str, Suspect]
) -> SharedError | None:
    """Return the error whose correction gains most; None if none gains enough."""
    w, fits = scan(reading, run, among.values())
    measured = values_of(reading.log)
    lost = _is_lost(w, measured)  # then the derivatives say little
    time_s = reading.log.time_s
    lasts_s = time_s[-1] - time_s[0] + time_s[1] - time_s[0]
    strict = np.clip(ENOUGH_S / lasts_s, 1.0, _STRICTEST)
    ranked = sorted(zip(among.values(), fits, strict=True), key=lambda pair: -pair[1].gain)
    certain = [
        rough.gain >= strict * suspect.gain
        and (lost or rough.wald >= strict * suspect.sure)
        and np.linalg.norm(rough.theta) >= suspect.least
        for suspect, rough in ranked
    ]
    if not any(certain):
        return None
    gains = {}
    errors = {}
    for suspect, rough in ranked if lost else ranked[:_TRIED]:
        error = _refined(reading, run, SharedError(suspect, rough.theta, rough.sigma))
        (new,) = innovations([without_errors(reading, [error])], run)
        limit = _MOST_DEVIATIONS * suspect.deviation
        single = suspect.parts and len(_parts(error, among)) < 2
        if not (single or _is_lost(new, measured)) and abs(error.theta).max() < limit:
            cost = suspect.cost + _COST * suspect.parameters
            gains[suspect.name] = float((rho(w) - rho(new)).sum()) - cost
            errors[suspect.name] = error
    best = max(gains, key=lambda name: gains[name], default="")
    if not best or gains[best] < 0.5 * strict * among[best].gain:
        return None
    rivals = [
        name
        for name in sorted(gains, key=lambda name: -gains[name])
        if name != best and not among[name].parts and gains[name] > gains[best] - _ALIKE
    ]
    return errors[best]._replace(rivals=rivals[:_MOST_RIVALS])


def _parts(error: SharedError, among: Mapping[str, Suspect]) -> list[SharedError]:
    """Return the certain parts of an error of several quantities; any other error as it is."""
    if not error.suspect.parts:
        return [error]
    return [
        SharedError(among[name], error.theta[k : k + 1], error.sigma[k : k + 1])
        for k, name in enumerate(error.suspect.parts)
        if abs(error.theta[k]) > max(_CERTAIN * error.sigma[k], among[name].least)
    ]


def _is_lost(w: Array, measured: Mask) -> bool:
    """Tell whether a track with these whitened innovations (T, rows) is lost in many epochs."""
    nis: Array = (w * w).sum(axis=1)
    return bool(np.mean(nis > _LOST_NIS * np.maximum(measured.sum(axis=1), 1)) > _LOST_SHARE)


def _refined(
    reading: Reading, run: FilterRun, error: SharedError, runs: int = _RUNS
) -> SharedError:
    """Return an error whose size is refined by undoing it and running the filter again."""
    suspect = error.suspect
    most = _MOST_DEVIATIONS * suspect.deviation
    theta = np.clip(error.theta, -most, most)
    for _ in range(runs):
        corrected = reading.without(suspect.undo(reading, theta))
        _, (rest,) = scan(corrected, run, [suspect])
        theta = np.clip(theta + rest.theta, -most, most)
        if np.linalg.norm(rest.theta / rest.sigma) < _SETTLED:
            break
    return error._replace(theta=theta, sigma=suspect.caution * rest.sigma)


def _again(reading: Reading, run: FilterRun, errors: list[SharedError]) -> list[SharedError]:
    """Return errors whose sizes are refined in turn, twice, with the others undone."""
    errors = errors.copy()
    for k in [*range(len(errors))] * 2:
        rest = without_errors(reading, errors[:k] + errors[k + 1 :])
        errors[k] = _refined(rest, run, errors[k], runs=1)
    return errors
