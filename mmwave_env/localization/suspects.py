"""Kinds of errors that all links of a log may share, or that a single anchor may have."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mmwave_env.localization.readings import (
    AZIMUTH,
    DEPARTURE,
    ELEVATION,
    Mistake,
    Reading,
    scaled,
    values_of,
)
from mmwave_env.numerics.numbers import Array, Mask

# Smallest Wald statistic that counts, and what each parameter after the first adds; smallest gain.
# Blockages make both too large, those of angles less than those of ranges.
_SURE = 25.0
_SURER = 5.0
_GAIN = 15.0
_SURE_OF_ANGLES = 8.0
_GAIN_OF_ELEVATIONS = 10.0
_JOINT_COST = 15.0  # additional cost of an error of several quantities, and of one anchor
_ANCHOR_COST = 3.0
_CAUTION = 1.5  # factor for standard deviations of ranges and elevations, which are too small
_SUBTRACT = "subtract {0:.3g} degrees from"
_RANGES = "ranges are too long"
_AZIMUTHS = "azimuths are turned"
_ELEVATIONS = "elevations are too large"
_DEGREE = np.pi / 180.0

Undo = Callable[[Reading, Array], Mistake]  # what undoes an error theta (p,) of a reading


class Suspect(NamedTuple):
    """A kind of error with p parameters theta, in m, degrees or percent."""

    name: str  # a sentence without the size
    undo: Undo
    unit: str  # unit of theta, in words
    cure: str = ""  # what to do besides correcting the scene; {0} is theta's last component
    parameters: int = 1  # number p of parameters
    least: float = 0.2  # smallest length of theta that counts
    sure: float = _SURE  # smallest Wald statistic that counts
    gain: float = _GAIN  # smallest gain that counts
    deviation: float = 10.0  # prior standard deviation of each parameter
    caution: float = 1.0  # factor for the standard deviations
    cost: float = 0.0  # additional cost
    parts: Sequence[str] = ()  # (p,) names of the suspects that this one combines

    def words(self, theta: Array, sigma: Array) -> str:
        """Return the sentence with the size of the error and its standard deviations (p,)."""
        sizes = [", ".join(f"{number:.2f}" for number in numbers) for numbers in (theta, sigma)]
        if self.parameters > 1:
            sizes = [f"({size})" for size in sizes]
        return f"{self.name} by {' ± '.join(sizes)} {self.unit}"


def _subtracted(*rows: slice) -> Undo:
    """Return the function that subtracts an angle, in degrees, from these rows."""
    return lambda reading, theta: Mistake("", "", scaled(rows, 1.0, -theta[0] * _DEGREE))


def _turned(reading: Reading, theta: Array) -> Mistake:
    scene = replace(reading.scene, bearing_deg=reading.scene.bearing_deg + float(theta[0]))
    return _subtracted(AZIMUTH, DEPARTURE)(reading, theta)._replace(scene=scene)


def _shortened(anchors: Sequence[int]) -> Undo:
    """Return the function that subtracts an offset, in m, from the ranges of anchors, from 0."""
    rows = [slice(4 * anchor, 4 * anchor + 1) for anchor in anchors]

    def undo(reading: Reading, theta: Array) -> Mistake:
        scene = reading.scene
        offsets = scene.offsets_m.copy()
        offsets[anchors] += theta[0]
        scene = replace(scene, range_offset_m=tuple(offsets.tolist()))
        return Mistake("", "", scaled(rows, 1.0, -theta[0]), scene=scene)

    return undo


def _moved(anchor: int, *axes: int) -> Undo:
    """Return the function that moves an anchor, from 0, along axes by theta (p,)."""

    def undo(reading: Reading, theta: Array) -> Mistake:
        anchors = reading.scene.anchors_m
        anchors[anchor, list(axes)] += theta
        return Mistake("", "", scene=reading.scene.with_anchors(anchors))

    return undo


def _moved_with_images(reading: Reading, theta: Array) -> Mistake:
    """Move the base station, of which walls make images, by theta (2,) horizontally."""
    x, y, z = reading.scene.base_station_m
    place = (x + float(theta[0]), y + float(theta[1]), z)
    return Mistake("", "", scene=replace(reading.scene, base_station_m=place))


def _rescaled(reading: Reading, theta: Array) -> Mistake:
    carrier_hz = reading.scene.carrier_hz * (1.0 + 0.01 * float(theta[0]))
    return Mistake("", "", scene=replace(reading.scene, carrier_hz=carrier_hz))


def _all_shifted(reading: Reading, theta: Array) -> Mistake:
    """Subtract theta (3,) from all ranges, azimuths and elevations."""
    turned = _turned(reading, theta[1:])
    anchors = range(len(reading.scene.anchors_m))
    shortened = _shortened(anchors)(reading.without(turned), theta)
    tilted = _subtracted(ELEVATION)(reading, theta[2:])
    changes = [*turned.changes, *shortened.changes, *tilted.changes]
    return shortened._replace(changes=changes)


def suspects(reading: Reading) -> dict[str, Suspect]:
    """Return the errors to look for in a reading, by name.

    Quantities that were not measured have none. A single anchor hides most errors, because the
    track gives way completely.
    """
    measured: Mask = np.any(values_of(reading.log), axis=0)
    rows = measured[:-1].reshape(-1, 4)
    every = [*_of_angles(rows)]
    if measured[-1]:
        every.append(
            Suspect("Doppler shifts are too large", _rescaled, "%", least=2.0, deviation=30.0)
        )
    if rows.any(axis=1).sum() > 1:
        every += _of_several(rows, reading.log.layout.has_bias)
        every += _of_anchors(rows)
        if reading.scene.walls:
            # more likely than a wrong image, because walls and the base station make the images
            station = _place("the base station with its images", _moved_with_images)
            every.append(station._replace(cost=0.0))
    return {suspect.name: suspect for suspect in every}


def _angle(name: str, undo: Undo, column: str = "", caution: float = 1.0) -> Suspect:
    """Return an error of angles; ``column`` names those that no key of a scene corrects."""
    cure = f"{_SUBTRACT} {column}" if column else ""
    sure = _SURE_OF_ANGLES
    return Suspect(name, undo, "degrees", cure, 1, 0.3, sure, deviation=30.0, caution=caution)


def _range(name: str, anchors: Sequence[int], cure: str = "") -> Suspect:
    undo = _shortened(anchors)
    return Suspect(f"{name} are too long", undo, "m", cure, deviation=30.0, caution=_CAUTION)


def _place(name: str, undo: Undo) -> Suspect:
    """Return an error of a horizontal position."""
    name = f"{name} is away from its place"
    return Suspect(name, undo, "m", "", 2, sure=_SURE + _SURER, deviation=5.0, cost=_ANCHOR_COST)


def _of_angles(rows: Mask) -> Iterator[Suspect]:
    """Yield errors of angles that a single anchor shows; ``rows`` (L, 4) were measured."""
    some: Mask = np.any(rows, axis=0)
    _, arrival, elevation, departure = some
    if arrival and departure:
        yield _angle("azimuths of arrival are turned", _subtracted(AZIMUTH), "aoa_azimuth")
        yield _angle("azimuths of departure are turned", _subtracted(DEPARTURE), "aod_azimuth")
    if elevation:
        undo = _subtracted(ELEVATION)
        suspect = _angle(_ELEVATIONS, undo, "aoa_elevation", _CAUTION)
        yield suspect._replace(gain=_GAIN_OF_ELEVATIONS)


def _of_several(rows: Mask, clock: bool) -> Iterator[Suspect]:
    """Yield errors that several anchors show; an unknown clock hides what all ranges share."""
    some: Mask = np.any(rows, axis=0)
    distance, arrival, elevation, departure = some
    if arrival or departure:
        yield _angle(_AZIMUTHS, _turned)
    if distance and not clock:
        cure = "or use --clock offset if the user's clock runs ahead, by {1:.3g} ns"
        yield _range("ranges", range(len(rows)), cure)
        if arrival and elevation and departure:
            yield Suspect(
                "several errors", _all_shifted, "", parameters=3, least=0.0,
                sure=_SURE + 2.0 * _SURER, cost=_JOINT_COST,
                parts=(_RANGES, _AZIMUTHS, _ELEVATIONS),
            )  # fmt: skip


def _of_anchors(rows: Mask) -> Iterator[Suspect]:
    """Yield the errors of each anchor that was measured."""
    for anchor in np.flatnonzero(rows.any(axis=1)).tolist():
        name = f"anchor {anchor + 1}"
        if rows[anchor, 0]:
            yield _range(f"ranges of {name}", [anchor])._replace(cost=_ANCHOR_COST)
        yield _place(name, _moved(anchor, 0, 1))
        if rows[anchor, [0, 2]].any():
            words = f"{name} is higher than in the scene"
            undo = _moved(anchor, 2)
            yield Suspect(words, undo, "m", deviation=5.0, caution=_CAUTION, cost=_ANCHOR_COST)
