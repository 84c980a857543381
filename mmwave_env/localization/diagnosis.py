"""Diagnosis of a log: a search for the mistake whose correction makes the log consistent.

A hypothesis says how to read the values in the file. For every hypothesis, a filter without
gates computes a track from the first epochs. A hypothesis makes the log consistent if
:mod:`~mmwave_env.localization.contradictions` finds no contradiction; for example, the NIS per
degree of freedom (dof) must be near 1. Consistent hypotheses are ranked by the likelihood of the
values in the file, not of the converted values, because likelihoods in different units can't be
compared. If no single mistake explains the log, pairs of mistakes are tried.

NIS does not show small errors that all links share. So a log that is consistent as it is, or that
no single mistake explains, is searched for them (:mod:`~mmwave_env.localization.shared_errors`).
"""

from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations

import numpy as np
from scipy.special import chdtri

from mmwave_env.localization.contradictions import Contradiction, contradictions, impossible
from mmwave_env.localization.readings import (
    AS_IT_IS,
    AZIMUTH,
    DEPARTURE,
    DOPPLER,
    ELEVATION,
    RANGE,
    Finding,
    Fits,
    Mistake,
    Reading,
    Undo,
    scaled,
    values_of,
)
from mmwave_env.localization.sensitivities import filtered
from mmwave_env.localization.shared_errors import (
    SharedError,
    scanned,
    shared_errors,
    without_errors,
)
from mmwave_env.localization.starts import POOL_S, start_at
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import QUANTITIES
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Array
from mmwave_env.world.episode import Episode

DIAGNOSED_EPOCHS = 200

_AZIMUTHS = (AZIMUTH, DEPARTURE)
_ANGLES = (*_AZIMUTHS, ELEVATION)
_COLUMNS = {
    "azimuth of arrival": ("aoa_azimuth", AZIMUTH),
    "azimuth of departure": ("aod_azimuth", DEPARTURE),
    "elevation": ("aoa_elevation", ELEVATION),
}
_FACTORS = {  # mistake -> the factor that undoes it, and the unit that the column really has
    "1e3 times too large (ms?)": (1e-3, "ms"),
    "1e6 times too large (us?)": (1e-6, "us"),
    "1e9 times too large (ns?)": (1e-9, "ns"),
    "1e3 times too small (s?)": (1e3, "s"),
    "1e6 times too small (s?)": (1e6, "s"),
    "1e9 times too small (s?)": (1e9, "s"),
}
_SEARCHED_EPOCHS = 50  # number of epochs among which the track's first epoch is chosen
_DECIMALS = 2  # of mean log-likelihoods; of hypotheses that fit equally well, the first is chosen
_ADVANTAGE = 10.0  # bonus for the log as it is, added to its log-likelihood
_OUTLIER_QUANTILE = 1e-6  # NIS is capped at the value that chi-square exceeds with this probability


def _timed(factor: float) -> Undo:
    """Return the function that multiplies the times."""
    return lambda reading: reading._replace(
        log=replace(reading.log, time_s=factor * reading.log.time_s)
    )


def _orders(anchors: int) -> Iterable[tuple[int, ...]]:
    """Return orders of the anchors in which all are rotated by one place, or two are exchanged."""
    right = np.arange(anchors)
    orders = [np.roll(right, -1), np.roll(right, 1)]
    for pair in combinations(right, 2):
        order = right.copy()
        order[[*pair]] = pair[::-1]
        orders.append(order)
    return dict.fromkeys(tuple(order.tolist()) for order in orders)


def mistakes(reading: Reading) -> Iterator[Mistake]:
    """Yield likely mistakes in a log, its scene and its radio."""
    scene = reading.scene
    yield from _conventions(scene)
    yield from _units(scene, reading.log.columns)
    for order in _orders(len(scene.anchors_m)):
        numbers = ", ".join(str(i + 1) for i in order)
        cure = f"list the anchors of the scene in the order {numbers}"
        moved = scene.with_anchors(scene.anchors_m[[*order]])
        undo = partial(Reading._replace, scene=moved)
        yield Mistake(f"anchors are the scene's {numbers}", cure, undo)
    for name in sorted(RADIOS.keys() - {reading.radio.name}):
        cure = f"use --radio {name}, or radio={name!r}"
        yield Mistake(f"radio is {name}", cure, partial(Reading._replace, radio=RADIOS[name]))


def _conventions(scene: Scene) -> Iterator[Mistake]:
    """Yield mistakes about the meaning of a value: exchanged columns, signs and zeros of angles."""
    swap = "exchange the columns of aoa_azimuth and"
    ends = scaled([AZIMUTH, DEPARTURE], sources=[DEPARTURE, AZIMUTH])
    turned = scaled([ELEVATION], -1.0)
    yield Mistake("arrival and departure are exchanged", f"{swap} aod_azimuth", ends)
    yield Mistake(
        "azimuth and elevation of arrival are exchanged",
        f"{swap} aoa_elevation",
        scaled([AZIMUTH, ELEVATION], sources=[ELEVATION, AZIMUTH]),
    )
    yield Mistake("elevation has the other sign", "negate aoa_elevation", turned)
    yield Mistake(
        "arrival is measured at the user (downlink)",
        f"{swap} aod_azimuth, negate aoa_elevation",
        lambda reading: turned(ends(reading)),
    )
    yield Mistake(
        "elevation is a zenith angle",
        "subtract aoa_elevation from 90 degrees",
        scaled([ELEVATION], -1.0, PI / 2.0),
    )
    yield Mistake(
        "elevation is a nadir angle",
        "subtract 90 degrees from aoa_elevation",
        scaled([ELEVATION], offset=-PI / 2.0),
    )
    yield Mistake(
        "azimuths are clockwise from north",
        "subtract aoa_azimuth and aod_azimuth from 90 degrees",
        scaled(_AZIMUTHS, -1.0, PI / 2.0),
    )
    yield Mistake(
        "azimuths are counterclockwise from north",
        "add 90 degrees to aoa_azimuth and to aod_azimuth",
        scaled(_AZIMUTHS, offset=PI / 2.0),
    )
    for name, column, rows in (
        ("azimuths have", "aoa_azimuth and aod_azimuth", _AZIMUTHS),
        ("azimuth of arrival has", "aoa_azimuth", [AZIMUTH]),
        ("azimuth of departure has", "aod_azimuth", [DEPARTURE]),
    ):
        yield Mistake(f"{name} the other sign", f"negate {column}", scaled(rows, -1.0))
    yield Mistake("times are round-trip times", "halve the time of flight", scaled([RANGE], 0.5))
    yield Mistake("Doppler shift has the other sign", "negate doppler", scaled([DOPPLER], -1.0))
    if scene.origin and (bearing := scene.origin.bearing_deg) != 90.0:
        yield Mistake(
            "azimuths are compass bearings",
            f"subtract aoa_azimuth and aod_azimuth from {bearing:g} degrees",
            scaled(_AZIMUTHS, -1.0, np.radians(bearing)),
        )
        yield Mistake(
            "azimuths are counterclockwise from east",
            f"add {bearing - 90.0:g} degrees to aoa_azimuth and to aod_azimuth",
            scaled(_AZIMUTHS, offset=np.radians(bearing - 90.0)),
        )


def _units(scene: Scene, columns: Set[str]) -> Iterator[Mistake]:
    """Yield mistakes about the units of columns; only those that the log has can be renamed."""
    for name, (column, rows) in _COLUMNS.items():
        if f"{column}_rad" in columns:
            cure = f"rename {column}_rad to {column}_deg"
            yield Mistake(f"{name} is in degrees", cure, scaled([rows], PI / 180.0))
    for unit, suffix, factor, other in (
        ("degrees", "deg", PI / 180.0, "rad"),
        ("radians", "rad", 180.0 / PI, "deg"),
    ):
        if any(f"{column}_{other}" in columns for column, _ in _COLUMNS.values()):
            cure = f"name the columns of angles after their unit, such as aoa_azimuth_{suffix}"
            yield Mistake(f"angles are in {unit}", cure, scaled(_ANGLES, factor))
    flights = QUANTITIES["toa"].columns
    if "range_m" in columns:
        feet = scaled([RANGE], flights["range_ft"].convert(1.0))
        yield Mistake("ranges are in feet", "rename range_m to range_ft", feet)
    for name in flights.keys() & columns:
        if name.startswith("toa"):
            meters = scaled([RANGE], 1.0 / flights[name].convert(1.0))
            yield Mistake(f"{name} is in meters", f"rename {name} to range_m", meters)
        if name.startswith("rtt"):
            cure = f"rename {name} to {name.replace('rtt', 'toa')}"
            yield Mistake(f"{name} is a one-way time", cure, scaled([RANGE], 2.0))
    timed = any(name.startswith(("toa", "rtt")) for name in columns)
    for error, (factor, unit) in _FACTORS.items():
        cure = f"multiply values by {factor:g}"
        rename = ", or name the column after its true unit, such as"
        flight = f"{cure}{rename} toa_{unit}" if timed else cure
        yield Mistake(f"time of flight is {error}", flight, scaled([RANGE], factor))
        yield Mistake(f"time is {error}", f"{cure}{rename} time_{unit}", _timed(factor))
    for unit, suffix, factor in (("m/s", "mps", scene.hz_per_mps), ("kHz", "khz", 1e3)):
        other = f"doppler_{suffix}"
        if "doppler_hz" in columns:
            words = f"Doppler shift is in {unit}, not in Hz"
            yield Mistake(words, f"rename doppler_hz to {other}", scaled([DOPPLER], factor))
        if other in columns:
            words = f"Doppler shift is in Hz, not in {unit}"
            yield Mistake(words, f"rename {other} to doppler_hz", scaled([DOPPLER], 1.0 / factor))


def _numbers(reading: Reading) -> Array:
    """Return all numbers that the filters read; a hypothesis that changes none has no effect."""
    log = reading.log
    parts = (
        log.time_s,
        log.measurement,
        np.where(values_of(log), reading.sigma, np.nan),
        reading.scene.anchors_m,
    )
    return np.concatenate([part.ravel() for part in parts])


def _start(log: Log) -> int:
    """Return the index of the epoch at which the tracks begin.

    This is the first epoch with a link of the base station. In a partial layout, links may be
    incomplete, and a position may need several links. Then the tracks begin at the epoch with the
    most measured values of links among 50 epochs, starting with the first that has a link.

    Raises:
        ValueError: no epoch has a link of the base station, and the layout is not partial.
    """
    count = values_of(log)[:, : log.layout.doppler].sum(axis=1)
    if not log.layout.partial:
        count = log.visible[:, 0] & (log.measurement[:, 0] > 0.0)
        if not count.any():
            raise ValueError(f"log: found no link of anchor 1 in {len(log)} epochs, expected one")
    first = int(np.argmax(count > 0))
    return first + int(np.argmax(count[first : first + _SEARCHED_EPOCHS]))


def diagnose(reading: Reading) -> list[Finding]:
    """Test which likely mistakes would explain the first epochs of a log.

    The scene and the radio of ``reading``, the log as it is, may be wrong. The log must come from
    :func:`~mmwave_env.logs.log.read_log` with ``limits=False`` and ``odometry=False``.

    Returns:
        A finding for the log as it is and for every hypothesis that changes a number. A finding of
        shared errors comes first. Then come hypotheses that make the log consistent, in order of
        likelihood; the others follow, in order of fit. If only pairs of hypotheses make the log
        consistent, the most likely pair is added at the top. In a partial layout, a pair must
        include the hypothesis of another radio.

    Raises:
        ValueError: there is no link with which a track could begin.
    """
    log = reading.log
    radio = reading.radio
    begin = _start(log)
    first = 0
    alone = start_at(log, begin, reading.scene, radio)
    if alone is None:  # the links of a second may begin a track
        first = int(np.searchsorted(log.time_s, log.time_s[begin] + POOL_S)) - begin
    epochs = slice(begin, begin + first + DIAGNOSED_EPOCHS)
    as_it_is = reading._replace(log=log.part(epochs))
    numbers = _numbers(as_it_is)
    single = [as_it_is.without(mistake) for mistake in mistakes(as_it_is)]
    single = [r for r in single if not np.array_equal(_numbers(r), numbers, equal_nan=True)]
    findings = _findings([as_it_is, *single], first)
    radios = {r.undone[0].words: r for r in single if r.radio is not radio}
    best = findings[0]
    if best.contradictions or best.hypothesis in {AS_IT_IS, *radios}:
        likely = [as_it_is, *filter(None, [radios.get(best.hypothesis)])]
        shared = [r for reading in likely for r in _without_shared_errors(log, reading)]
        findings = [f._replace(shared=True) for f in _findings(shared, first)] + findings
    if findings[0].contradictions and not findings[0].shared:
        double = [
            reading.without(*other.undone)
            for reading, other in permutations(single, 2)
            # computing a first position from incomplete links takes too long for all pairs
            if not (log.layout.partial or log.layout.has_bias) or reading.radio is not radio
        ]
        consistent = [f for f in _findings(double, first) if not f.contradictions]
        findings = consistent[:1] + findings
    return findings


def _without_shared_errors(log: Log, reading: Reading) -> list[Reading]:
    """Return the reading of a log's beginning without the errors that the log shows; [] if none.

    Values that are impossible, or too wrong for a filter, show no such errors.
    """
    errors: list[SharedError] = []
    if not impossible(log):
        with suppress(ValueError):
            errors = shared_errors(scanned(reading._replace(log=log)))
    return [without_errors(reading, errors)] if errors else []


def _findings(readings: Sequence[Reading], first: int) -> list[Finding]:
    """Return a finding on each reading, the best first; tracks begin with the epoch ``first``."""
    findings: list[Finding] = []
    if not readings:
        return findings
    tracked = []
    episodes = []
    for reading in readings:
        why = impossible(reading.log)
        if not why:
            try:
                begun = reading.with_start(first)
                if begun.start is None:
                    raise ValueError("the first epochs determine no position")
                episodes.append(begun.episode)
                tracked.append(begun)
            except ValueError as error:
                why = [Contradiction("track", f"none ({error})", "a track")]
        if why:
            findings.append(reading.finding(why))
    if episodes:
        results = filtered(episodes, tracked[0].mode, "memory.nis", "log_likelihood")
        findings += map(_finding, tracked, episodes, *results)
    return sorted(findings, key=lambda finding: _rank(finding, len(readings[0].log)))


def _rank(finding: Finding, epochs: int) -> tuple[bool, float]:
    """Return a sort key: consistent findings by likelihood, then inconsistent ones by fit."""
    if not finding.contradictions and finding.log_likelihood is not None:
        advantage = _ADVANTAGE / epochs if finding.hypothesis == AS_IT_IS else 0.0
        return False, -round(finding.log_likelihood + advantage, _DECIMALS)
    worst = finding.worst_anchor
    return True, np.inf if worst is None else abs(np.log(worst))


def _finding(reading: Reading, episode: Episode, nis: Array, likelihood: Array) -> Finding:
    """Return the finding on a reading with a track: NIS (T, groups) and log-likelihoods (T,)."""
    log = reading.log
    layout = log.layout
    dof = np.add.reduceat(values_of(log), layout.starts, axis=1, dtype=np.int64).clip(1)
    ratios = nis / chdtri(dof, 0.5)
    fits: Fits = {}
    groups = {}
    for name, used, column in zip(layout.group_names, episode.visible.T, ratios.T, strict=True):
        fits[name] = float(np.median(column[used])) if used.any() else None
        groups[name] = {"seen": used.sum(), "rejected_share": 0.0, "nis_per_dof": fits[name]}
    if not np.isfinite(likelihood).all():
        return reading.finding([Contradiction("track", "NaN or infinity", "numbers")], fits)
    clipped = np.maximum(nis - chdtri(dof, _OUTLIER_QUANTILE), 0.0).sum()
    mean = (float(likelihood.sum() + 0.5 * clipped) + reading.log_scale) / len(log)
    return reading.finding(contradictions(log, reading.scene, reading.radio, groups), fits, mean)
