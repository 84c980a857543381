"""Errors that all links of a log share: azimuths turned, ranges too long, an anchor off its place.

Links agree about such an error, so gates and NIS show nothing. But the error changes the
innovations of the whole track (:mod:`~mmwave_env.localization.sensitivities`). An error that may be
present is refined by undoing it and running the filter again. What counts is the gain of the
corrected log: by how much the sum of Huber's function of the innovations decreases.
"""

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d

from mmwave_env.localization.readings import (
    AZIMUTH,
    DEPARTURE,
    ELEVATION,
    RANGE,
    Mistake,
    Reading,
    scaled,
    values_of,
)
from mmwave_env.localization.segments import stretches
from mmwave_env.localization.sensitivities import fit, innovations, rho
from mmwave_env.localization.starts import gives_fix
from mmwave_env.logs.log import Log
from mmwave_env.models.layout import LINK
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.models.scene import Scene, scene_json
from mmwave_env.numerics.numbers import Array, Mask

SCANNED_EPOCHS = 1000
LEAST_EPOCHS = 100
LEAST_S = 10.0
ENOUGH_S = 100.0  # in shorter logs, an error must be more certain, because blockages look like one
LONGEST_STEP_S = 2.0
# Smallest Wald statistic that counts, and what each parameter after the first adds.
# Blockages make it and the gain too large, those of angles less than those of ranges.
_SURE = 25.0
_SURER = 5.0
_SURE_OF_ANGLES = 8.0
_GAIN = 15.0
_GAIN_OF_ELEVATIONS = 10.0
_JOINT_COST = 15.0  # additional cost of an error of several quantities, and of one anchor
_ANCHOR_COST = 3.0
_LEAST_WITHOUT_HEIGHT_M = 0.6  # a height that only ranges tell looks like errors up to this size
_CAUTION = 1.5  # factor for standard deviations of ranges and elevations, which are too small

_STEP = 0.5  # of a parameter, for finite differences
_RUNS = 3  # maximum number of runs of the filter that refine an error
_SETTLED = 0.1  # an error is refined if its last change was less, in standard deviations
_MOST_DEVIATIONS = 3.0  # largest size of an error, in standard deviations of its prior
_ENOUGH_ANCHORS = 4  # with fewer, errors of an anchor need links with all angles
_COST = 3.0  # gain that each parameter must bring
_TRIED = 6  # suspects, those with the largest gains, that are refined if one of all is certain
_ALIKE = 6.0  # errors whose gains differ by less can't be told apart
_MOST_RIVALS = 3  # that are named
# A corrected track with more than this share of epochs with so large a NIS / dof is lost.
_LOST_NIS = 50.0
_LOST_SHARE = 0.1
_MOST_ROUNDS = 3
# An epoch is wild if its NIS is larger than both, the median's multiple and this value.
_WILD_RATIO = 100.0
_WILD_NIS = 1e4
_NEARBY = 11  # epochs
_MOST_WILD_ROUNDS = 10
_STRICTEST = 5.0  # largest factor by which the limits are higher in shorter logs
_CERTAIN = 3.0  # standard deviations by which a part of an error differs from 0
_DIGITS = 3  # decimals of sizes
_OPPOSITES = {"long": "short", "large": "small", "higher": "lower"}  # of words in names
_NANOSECOND_M = 1e-9 * SPEED_OF_LIGHT


class Suspect(NamedTuple):
    """A kind of error with p parameters theta, in m, degrees or percent."""

    name: str  # a sentence without the size
    unit: str  # unit of theta, in words
    rows: Sequence[slice] = ()  # rows of a measurement that are too large by theta (1,)
    # the scene as it is if it lacks the error; the arguments are the scene and each of theta
    scene: Callable[..., Scene] = lambda scene, *theta: scene
    cure: str = ""  # what to do besides correcting the scene; {0} is theta's last component
    parameters: int = 1  # number p of parameters
    least: float = 0.2  # smallest length of theta that counts
    sure: float = _SURE  # smallest Wald statistic that counts
    gain: float = _GAIN  # smallest gain that counts
    deviation: float = 30.0  # prior standard deviation of each parameter
    caution: float = 1.0  # factor for the standard deviations
    cost: float = 0.0  # additional cost
    parts: Sequence["Suspect"] = ()  # (p,) suspects with one parameter that this one combines
    since_s: float | None = None  # if it is given, theta[0] is the growth in 100 s from this time

    def correct(self, reading: Reading, theta: Array) -> Reading:
        """Return a reading in which the error theta (p,) is undone."""
        for part, size in zip(self.parts, theta, strict=False):
            reading = part.correct(reading, np.array([size]))
        excess: Any = np.radians(theta[0]) if self.unit == "degrees" else theta[0]
        if self.since_s is not None:
            excess = excess * (reading.log.time_s[:, None] - self.since_s) / 100.0
        moved = reading._replace(scene=self.scene(reading.scene, *theta.tolist()))
        return scaled(self.rows, offset=-excess)(moved)


_ANGLES = Suspect("", "degrees", least=0.3, sure=_SURE_OF_ANGLES)
_TURN = _ANGLES._replace(
    name="azimuths are turned",
    rows=(AZIMUTH, DEPARTURE),
    scene=lambda scene, degrees: replace(scene, bearing_deg=scene.bearing_deg + degrees),
)
_TILT = _ANGLES._replace(
    name="elevations are too large",
    rows=[ELEVATION],
    cure="subtract {0:.3g} degrees from aoa_elevation",
    gain=_GAIN_OF_ELEVATIONS,
    caution=_CAUTION,
)
_SCALE = Suspect(
    "Doppler shifts are too large",
    "%",
    scene=lambda scene, percent: replace(
        scene, carrier_hz=scene.carrier_hz * (1.0 + 0.01 * percent)
    ),
    least=2.0,
)
_PLACE = Suspect("", "m", parameters=2, sure=_SURE + _SURER, deviation=5.0)  # horizontal


def _moved_with_images(scene: Scene, east_m: float, north_m: float) -> Scene:
    """Move the base station, of which walls make images."""
    x, y, z = scene.base_station_m
    return replace(scene, base_station_m=(x + east_m, y + north_m, z))


def _range(name: str, anchors: Sequence[int], cure: str = "", cost: float = 0.0) -> Suspect:
    """Return an error of the ranges of anchors, counted from 0."""

    def shortened(scene: Scene, excess_m: float) -> Scene:
        offsets = scene.offsets_m
        offsets[anchors] += excess_m
        return replace(scene, range_offset_m=tuple(offsets.tolist()))

    rows = [slice(4 * anchor, 4 * anchor + 1) for anchor in anchors]
    name = f"{name} are too long"
    return Suspect(name, "m", rows, shortened, cure, caution=_CAUTION, cost=cost)


def _moved(anchor: int, *axes: int) -> Callable[..., Scene]:
    """Return the function that moves an anchor, from 0, along axes by some meters."""

    def moved(scene: Scene, *away_m: float) -> Scene:
        anchors = scene.anchors_m
        anchors[anchor, axes] += away_m
        return scene.with_anchors(anchors)

    return moved


def suspects(reading: Reading) -> Iterator[Suspect]:
    """Yield the errors to look for in a reading.

    Quantities that were not measured have none. A single anchor hides most errors, because the
    track gives way completely. An unknown clock hides what all ranges share.
    """
    measured: Mask = np.any(values_of(reading.log), axis=0)
    rows = measured[:-1].reshape(-1, 4)
    distance, arrival, elevation, departure = np.any(rows, axis=0)
    if arrival and departure:
        for name, row, column in (("arrival", AZIMUTH, "aoa"), ("departure", DEPARTURE, "aod")):
            cure = f"subtract {{0:.3g}} degrees from {column}_azimuth"
            yield _ANGLES._replace(name=f"azimuths of {name} are turned", rows=[row], cure=cure)
    if elevation:
        yield _TILT
    if measured[-1]:
        yield _SCALE
    anchors = rows.any(axis=1).sum()
    whole = arrival and elevation and departure
    if anchors < 2:
        return
    if arrival or departure:
        yield _TURN
    if distance and not reading.log.layout.has_bias:
        cure = ", or use --clock offset if the user's clock is off, by {1:+.3g} ns"
        late = _range("ranges", range(len(rows)), cure)
        if not elevation:
            late = late._replace(least=_LEAST_WITHOUT_HEIGHT_M)
        yield late
        drift = Suspect(
            "the user's clock drifts: ranges grow too long",
            "m in 100 s",
            (RANGE,),
            cure="use --clock offset, as the user's clock gains {1:.3g} ns in 100 s",
            least=late.least,
            deviation=100.0,
            caution=_CAUTION,
            since_s=float(reading.log.time_s[0]),
        )
        yield drift
        if whole:
            yield Suspect(
                "several errors", "", parameters=4, least=0.0, sure=_SURE + 3.0 * _SURER,
                deviation=10.0, cost=_JOINT_COST, parts=(late, _TURN, _TILT, drift),
            )  # fmt: skip
    if not whole and anchors < _ENOUGH_ANCHORS:
        return  # a track that gives way explains them, and blockages look like them
    yield from _of_anchors(rows)
    if reading.scene.walls:
        # more likely than a wrong image, because walls and the base station make the images
        name = "the base station with its images is away from its place"
        yield _PLACE._replace(name=name, scene=_moved_with_images)


def _of_anchors(rows: Mask) -> Iterator[Suspect]:
    """Yield the errors of each anchor, given which of their rows (L, 4) were measured."""
    place = _PLACE._replace(cost=_ANCHOR_COST)
    for anchor in np.flatnonzero(rows.any(axis=1)).tolist():
        name = f"anchor {anchor + 1}"
        if rows[anchor, 0]:
            yield _range(f"ranges of {name}", [anchor], cost=_ANCHOR_COST)
        yield place._replace(name=f"{name} is away from its place", scene=_moved(anchor, 0, 1))
        if rows[anchor, [0, 2]].any():
            words = f"{name} is higher than in the scene"
            up = _moved(anchor, 2)
            yield Suspect(words, "m", (), up, deviation=5.0, caution=_CAUTION, cost=_ANCHOR_COST)


class SharedError(NamedTuple):
    """An error that a log shows."""

    suspect: Suspect
    theta: Array  # (p,) its size, in the unit of the suspect
    sigma: Array  # (p,) standard deviations
    wald: float = 0.0  # theta' V^-1 theta, with the covariance V of theta
    gain: float = 0.0  # gain of the corrected log, minus costs, if it is known; else the fit's
    rivals: Sequence[str] = ()  # names of other suspects that explain the log about as well

    def __str__(self) -> str:
        name = self.suspect.name
        theta = self.theta
        for word, opposite in _OPPOSITES.items():
            if word in name and theta[0] < 0.0:
                name = name.replace(word, opposite)
                theta = -theta
        sizes = [", ".join(f"{number:.2f}" for number in each) for each in (theta, self.sigma)]
        if self.suspect.parameters > 1:
            sizes = [f"({size})" for size in sizes]
        others = f" (or {', or '.join(self.rivals)})" if self.rivals else ""
        return f"{name} by {' ± '.join(sizes)} {self.suspect.unit}{others}"

    def undone(self, reading: Reading) -> Reading:
        """Return a reading in which the error is undone, with words and cure."""
        size = float(self.theta[-1])
        cure = self.change(reading) + self.suspect.cure.format(size, size / _NANOSECOND_M)
        undo = partial(self.suspect.correct, theta=self.theta)
        return reading.without(Mistake(str(self), cure, undo))

    def change(self, reading: Reading) -> str:
        """Return what to write into the file of the reading's scene; "" if nothing."""
        before = scene_json(reading.scene)
        after = scene_json(self.suspect.correct(reading, self.theta).scene)
        changed = {
            key: np.round(value, _DIGITS).tolist()
            for key, value in after.items()
            if before.get(key) != value
        }
        if not changed:
            return ""
        instead = [key for key in before if key not in after]
        places = f", instead of {', '.join(instead)}," if instead else ""
        return f"write {json.dumps(changed)[1:-1]}{places} into the scene's file"


def scanned(reading: Reading) -> Reading | None:
    """Return the epochs of a reading to look for shared errors in.

    They are the first 1,000 epochs, at least 100, of the first track of at least 10 s. Of a track
    with more epochs in 100 s, epochs in between are left out. The result is None if there is no
    such track, or if its steps are longer than 2 s.

    A complete link of the base station gives each of their readings a start of its own. Other
    starts take long to compute, and a track forgets them soon; so readings share them.
    """
    log = _without_odometry(reading.log)
    for epochs, start in stretches(log, reading.scene, reading.radio):
        part = log.part(epochs)
        if len(part) < LEAST_EPOCHS:
            continue
        step_s = float(np.median(np.diff(part.time_s)))
        stride = max(1, int(np.ceil(ENOUGH_S / (SCANNED_EPOCHS * step_s) - 1e-9)))
        part = part.part(slice(0, SCANNED_EPOCHS * stride, stride))
        step_s *= stride
        enough = len(part) >= LEAST_EPOCHS and len(part) * step_s >= LEAST_S
        if enough and step_s <= LONGEST_STEP_S:
            link = part.measurement[:1, : len(LINK)]
            whole = start.spent[0, 0] and np.isfinite(link).all() and gives_fix(link)[0]
            own = whole and not part.layout.has_bias
            return without_wild(reading._replace(log=part, start=None if own else start))
    return None


def without_wild(reading: Reading) -> Reading:
    """Return a reading without the epochs that would move a track, without gates, far away.

    The epochs after such an epoch have a large NIS, too, so only the largest one nearby is left
    out before the filter runs again.
    """
    for _ in range(_MOST_WILD_ROUNDS):
        (w,) = innovations([reading])
        nis = np.square(w).sum(axis=1)
        nis[0] = 0.0  # the track begins here
        limit = max(_WILD_NIS, _WILD_RATIO * np.median(nis))
        wild = (nis > limit) & (nis == maximum_filter1d(nis, _NEARBY))
        if not wild.any():
            break
        log = reading.log
        reading = reading._replace(log=replace(log, visible=log.visible & ~wild[:, None]))
    return reading


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


def shared_errors(reading: Reading | None, rounds: int = _MOST_ROUNDS) -> list[SharedError]:
    """Return the errors of :func:`scanned` epochs that all links share, or that one anchor has.

    The first error is the most likely one. The list is empty if there are no such epochs. A round
    looks for one more error.

    Raises:
        ValueError: values are too wrong for a filter.
    """
    if reading is None:
        return []
    among = list(suspects(reading))
    errors: list[SharedError] = []
    corrected = reading
    for _ in range(rounds):
        error = _likeliest(corrected, among)
        if error is None:
            break
        errors += _parts(error)
        if len(errors) > 1:
            for k in [*range(len(errors))] * 2:  # refine sizes in turn, with the others undone
                rest = without_errors(reading, errors[:k] + errors[k + 1 :])
                errors[k] = _refined(rest, errors[k], runs=1)
            errors = [error for error in errors if _counts(error)]
        corrected = without_errors(reading, errors)
    return [error._replace(theta=error.theta.round(_DIGITS)) for error in errors]


def without_errors(reading: Reading, errors: Sequence[SharedError]) -> Reading:
    """Return a reading in which errors are undone, one after the other."""
    for error in errors:
        reading = error.undone(reading)
    return reading


def _scan(reading: Reading, among: Collection[Suspect]) -> tuple[Array, list[SharedError]]:
    """Return the whitened innovations (T, rows) of a reading, and the fit of every suspect."""
    steps = [
        suspect.correct(reading, step)
        for suspect in among
        for step in _STEP * np.eye(suspect.parameters)
    ]
    w = innovations([reading, *steps])
    J = np.moveaxis(w[0] - w[1:], 0, -1) / _STEP
    ends = np.cumsum([suspect.parameters for suspect in among])[:-1]
    parts = zip(among, np.split(J, ends, axis=-1), strict=True)
    return w[0], [SharedError(each, *fit(w[0], part, each.deviation)) for each, part in parts]


def _likeliest(reading: Reading, among: Collection[Suspect]) -> SharedError | None:
    """Return the error whose correction gains most; None if none gains enough."""
    w, fits = _scan(reading, among)
    lost = _is_lost(w)  # then the derivatives say little
    time_s = reading.log.time_s
    lasts_s = time_s[-1] - time_s[0] + time_s[1] - time_s[0]
    strict = np.clip(ENOUGH_S / lasts_s, 1.0, _STRICTEST)
    if not any(
        rough.gain >= strict * rough.suspect.gain
        and (lost or rough.wald >= strict * rough.suspect.sure)
        and np.linalg.norm(rough.theta) >= rough.suspect.least
        for rough in fits
    ):
        return None
    candidates = []
    tried = None if lost else _TRIED
    for rough in sorted(fits, key=_loss)[:tried]:
        error = _refined(reading, rough)
        suspect = error.suspect
        (new,) = innovations([suspect.correct(reading, error.theta)])
        limit = _MOST_DEVIATIONS * suspect.deviation
        single = suspect.parts and len(_parts(error)) < 2
        extreme = abs(error.theta).max() >= limit
        if _counts(error) and not (single or extreme or _is_lost(new)):
            cost = suspect.cost + _COST * suspect.parameters
            candidates.append(error._replace(gain=float((rho(w) - rho(new)).sum()) - cost))
    if not candidates:
        return None
    best, *others = sorted(candidates, key=_loss)
    rivals = [
        error.suspect.name
        for error in others
        if not error.suspect.parts and error.gain > best.gain - _ALIKE
    ]
    enough = best.gain >= 0.5 * strict * best.suspect.gain
    return best._replace(rivals=rivals[:_MOST_RIVALS]) if enough else None


def _loss(error: SharedError) -> float:
    return -error.gain


def _counts(error: SharedError) -> bool:
    """Tell whether an error is large enough, and certain."""
    certain = np.linalg.norm(error.theta / error.sigma) >= _CERTAIN
    return bool(certain and np.linalg.norm(error.theta) >= error.suspect.least)


def _parts(error: SharedError) -> list[SharedError]:
    """Return the certain parts of an error of several quantities; any other error as it is."""
    if not error.suspect.parts:
        return [error]
    return [
        SharedError(part, error.theta[k : k + 1], error.sigma[k : k + 1])
        for k, part in enumerate(error.suspect.parts)
        if abs(error.theta[k]) > max(_CERTAIN * error.sigma[k], part.least)
    ]


def _is_lost(w: Array) -> bool:
    """Tell whether a track with these whitened innovations (T, rows) is lost in many epochs."""
    dof = np.maximum(np.count_nonzero(w, axis=1), 1)
    return bool(np.mean((w * w).sum(axis=1) > _LOST_NIS * dof) > _LOST_SHARE)


def _refined(reading: Reading, error: SharedError, runs: int = _RUNS) -> SharedError:
    """Return an error whose size is refined by undoing it and running the filter again."""
    suspect = error.suspect
    most = _MOST_DEVIATIONS * suspect.deviation
    theta = np.clip(error.theta, -most, most)
    for _ in range(runs):
        _, (rest,) = _scan(suspect.correct(reading, theta), [suspect])
        theta = np.clip(theta + rest.theta, -most, most)
        if np.linalg.norm(rest.theta / rest.sigma) < _SETTLED:
            break
    return error._replace(theta=theta, sigma=suspect.caution * rest.sigma)
