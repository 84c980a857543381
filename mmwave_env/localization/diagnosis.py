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

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise, permutations

import numpy as np
from scipy.special import chdtri

from mmwave_env.io.files import shipped_json
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
    scaled,
    values_of,
)
from mmwave_env.localization.sensitivities import filtered
from mmwave_env.localization.shared_errors import (
    SharedError,
    scanned,
    shared_errors,
    without_errors,
    without_wild,
)
from mmwave_env.localization.starts import POOL_S, start_at
from mmwave_env.logs.log import Log
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import RADIOS
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode

DIAGNOSED_EPOCHS = 200

_ROWS = {
    "range": RANGE,
    "azimuth": AZIMUTH,
    "elevation": ELEVATION,
    "departure": DEPARTURE,
    "doppler": DOPPLER,
}
_SEARCHED_EPOCHS = 50  # number of epochs among which the track's first epoch is chosen
_DECIMALS = 2  # of mean log-likelihoods; of hypotheses that fit equally well, the first is chosen
_ADVANTAGE = 10.0  # bonus for the log as it is, added to its log-likelihood
_OUTLIER_QUANTILE = 1e-6  # NIS is capped at the value that chi-square exceeds with this probability


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
    yield from _conventions(reading)
    for order in _orders(len(scene.anchors_m)):
        numbers = ", ".join(str(i + 1) for i in order)
        cure = f"list the anchors of the scene in the order {numbers}"
        moved = scene.with_anchors(scene.anchors_m[[*order]])
        undo = partial(Reading._replace, scene=moved)
        yield Mistake(f"anchors are the scene's {numbers}", cure, undo)
    for name in sorted(RADIOS.keys() - {reading.radio.name}):
        cure = f"use --radio {name}, or radio={name!r}"
        yield Mistake(f"radio is {name}", cure, partial(Reading._replace, radio=RADIOS[name]))


def _conventions(reading: Reading) -> Iterator[Mistake]:
    """Yield mistakes about the meaning, the sign and the unit of values.

    They are listed in ``data/mistakes.json``. The regular expression ``columns`` must be found in
    the names of the log's columns. ``values`` are undone by replacing them by ``times`` * values of
    ``from`` + ``plus_deg``. With ``bearing``, the bearing of the scene's x axis is added, too; such
    a mistake is possible if this axis does not point east. ``hz_per_mps`` is the power of the
    carrier's Hz per m/s that is another factor.
    """
    scene = reading.scene
    names = " ".join(sorted(reading.log.columns))
    bearing_deg = scene.origin.bearing_deg if scene.origin else 90.0
    for entry in shipped_json("mistakes")["mistakes"]:
        turned = "bearing" in entry
        if not re.search(entry.get("columns", ""), names) or (turned and bearing_deg == 90.0):
            continue
        values = entry["values"]
        sources = entry.get("from", values)
        factor = np.multiply(
            entry.get("times", 1.0), scene.hz_per_mps ** entry.get("hz_per_mps", 0)
        )
        offset_deg = entry.get("plus_deg", 0.0) + turned * bearing_deg
        undo = (
            partial(_timed, factor=factor)
            if values == ["time"]
            else scaled(
                [_ROWS[name] for name in values],
                factor,
                np.radians(offset_deg),
                [_ROWS[name] for name in sources],
            )
        )
        yield Mistake(entry["words"], entry["cure"].format(offset_deg), undo)


def _timed(reading: Reading, factor: float) -> Reading:
    """Return the reading with times multiplied by a factor."""
    log = reading.log
    return reading._replace(log=replace(log, time_s=factor * log.time_s))


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


def _unbroken(log: Log) -> Log:
    """Return the longest part of a log without a step that is too long for a filter.

    If the unit of time may be wrong, the usual step says which steps are too long. Of parts that
    are long enough to be diagnosed, the first is chosen.
    """
    steps = np.diff(log.time_s, prepend=log.time_s[0])
    longest = GAP_S * max(4.0, np.median(steps))  # at least 60 s, which a filter can predict
    ends = [0, *np.flatnonzero(steps > longest).tolist(), len(log)]
    parts = [log.part(slice(*part)) for part in pairwise(ends)]
    return max(parts, key=lambda part: min(len(part), DIAGNOSED_EPOCHS))


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
    whole = reading.log
    log = _unbroken(whole)
    radio = reading.radio
    begin = _start(log)
    first = 0
    alone = start_at(log, begin, reading.scene, radio)
    if alone is None:  # the links of a second may begin a track
        first = int(np.searchsorted(log.time_s, log.time_s[begin] + POOL_S)) - begin
    epochs = slice(begin, begin + first + DIAGNOSED_EPOCHS)
    as_it_is = reading._replace(log=log.part(epochs))
    with suppress(ValueError):  # values may be too wrong for a filter
        as_it_is = without_wild(as_it_is)
    numbers = _numbers(as_it_is)
    single = [as_it_is.without(mistake) for mistake in mistakes(as_it_is)]
    single = [r for r in single if not np.array_equal(_numbers(r), numbers, equal_nan=True)]
    findings = _findings([as_it_is, *single], first)
    radios = {r.undone[0].words: r for r in single if r.radio is not radio}
    best = findings[0]
    if best.contradictions or not best.misread:
        likely = [as_it_is, *filter(None, [radios.get(best.hypothesis)])]
        shared = [r for reading in likely for r in _without_shared_errors(whole, reading)]
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
    tracked = []
    episodes = []
    for reading in readings:
        why = impossible(reading.log)
        if not why:
            try:
                begun = reading.with_start(first)
                if begun.start is None:
                    raise ValueError(
                        "the first epochs determine no position, or two, between which --start "
                        "decides; or an anchor is straight above or below the user"
                    )
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


def _rank(finding: Finding, epochs: int) -> tuple[bool, bool, float]:
    """Return a sort key: consistent findings by likelihood, then inconsistent ones by fit.

    A consistent log is read as it is, perhaps with another radio, even if another reading is more
    likely: if a user stands still, steps of milliseconds are more likely than those of seconds.
    """
    if not finding.contradictions and finding.log_likelihood is not None:
        advantage = _ADVANTAGE / epochs if finding.hypothesis == AS_IT_IS else 0.0
        return False, finding.misread, -round(finding.log_likelihood + advantage, _DECIMALS)
    worst = finding.worst_anchor
    return True, True, np.inf if worst is None else abs(np.log(worst))


def _finding(reading: Reading, episode: Episode, nis: Array, likelihood: Array) -> Finding:
    """Return the finding on a reading with a track: NIS (T, groups) and log-likelihoods (T,)."""
    log = reading.log
    layout = log.layout
    dof = np.add.reduceat(values_of(log), layout.starts, axis=1, dtype=np.int64).clip(1)
    ratios = nis / chdtri(dof, 0.5)
    fits: Fits = {}
    groups = {}
    for name, used, column in zip(layout.group_names, episode.visible.T, ratios.T, strict=True):
        fits[name] = fit = float(np.median(column[used])) if used.any() else None
        epochs = used.sum() + (fit or 0.0)  # even a few epochs say that a NIS is huge
        groups[name] = {"seen": epochs, "rejected_share": 0.0, "nis_per_dof": fit}
    if not np.isfinite(likelihood).all():
        return reading.finding([Contradiction("track", "NaN or infinity", "numbers")], fits)
    clipped = np.maximum(nis - chdtri(dof, _OUTLIER_QUANTILE), 0.0).sum()
    mean = (float(likelihood.sum() + 0.5 * clipped) + reading.log_scale) / len(log)
    # A small NIS is no reason to read a log in a less likely way: with ranges alone, it is that of
    # a pedestrian in the filter of a vehicle.
    why = contradictions(log, reading.scene, reading.radio, groups, small_nis=False)
    return reading.finding(why, fits, mean)
