"""The noise of a log: steps of ranges, jumps of the clock, and noise that is not as stated.

The default radio profile of a log is the shipped profile with the noise most like the log's.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np

from mmwave_env.localization.readings import (
    AZIMUTH,
    DEPARTURE,
    ELEVATION,
    RANGE,
    Reading,
    values_of,
)
from mmwave_env.localization.sensitivities import innovations
from mmwave_env.localization.shared_errors import (
    LEAST_EPOCHS,
    LEAST_S,
    LONGEST_STEP_S,
    scanned,
    shared_errors,
    without_errors,
)
from mmwave_env.localization.starts import deviations_of
from mmwave_env.logs.log import Log
from mmwave_env.models.layout import LINK, wrapped
from mmwave_env.models.radio import RADIOS, Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, wrap
from mmwave_env.world.episode import NEUTRAL_SNR_DB

_FEWEST = 10  # minimum number of differences between neighboring values, to conclude a step
_SMALLEST_M = 1e-5  # differences up to this one are rounding errors
_NEAR_STEPS = 20  # larger differences, in steps, are not compared: the step is not exact enough
_OFF = 0.05  # largest deviation of a difference from a multiple of the step, in steps
_MULTIPLES = 0.95  # share of differences that must be multiples
_NOTICED = 0.5  # shortest step that matters, in standard deviations of the ranges
_FASTEST_MPS = 50.0  # a change of range that is faster, and alike in all links, is a clock's
_JUMP_SIGMAS = 8.0
_ALIKE = 0.25  # tolerated difference between the jumps of two links, as a fraction
_JUMPS = 0.02  # share of epochs from which on a clock is said to jump
# The noise is reported if its factor is outside these limits, or its correlation above this one.
_FACTORS = (0.6, 1.5)
_CORRELATED = 0.35
_MEDIAN = 0.6745  # median of the absolute value of a standard normal number
_CLIPPED = 2.0  # largest noise that counts: blockages correlate what is larger
_LAGS = 8
_TOO_SHORT = (
    f"errors that all links share were not looked for: no track has {LEAST_EPOCHS} epochs and "
    f"{LEAST_S:g} s, with steps of up to {LONGEST_STEP_S:g} s"
)
_ENOUGH = 100  # minimum number of values for a conclusion
_FEWEST_CHANGES = 20  # minimum number of second differences for a median
_ROBUST = 1.4826 / np.sqrt(6.0)  # white noise: standard deviation / median |second difference|


def _measured(log: Log) -> Array:
    """Return the values (T, rows) of a log, NaN where nothing was measured."""
    return np.where(values_of(log), log.measurement, np.nan)


def with_range_steps(log: Log, scene: Scene, radio: Radio) -> tuple[Log, float | None]:
    """Return a log with the noise of rounding added to its ranges, and the step (m) of the ranges.

    The step is None if the ranges come in no step that matters; else the differences between
    neighboring values of an anchor are multiples of the smallest one, and values are repeated: the
    ranges of a user at a constant speed only grow by steps. The error of rounding to steps of
    length q has the variance q^2 / 12.
    """
    deviations = deviations_of(log, scene, radio)[:, log.layout.ranges]
    ranges = _measured(log)[:, log.layout.ranges]
    gaps = np.diff(np.sort(ranges, axis=0), axis=0)
    repeated = np.count_nonzero(gaps <= _SMALLEST_M)
    gaps = gaps[gaps > _SMALLEST_M]  # not NaN
    gaps = gaps[gaps < _NEAR_STEPS * gaps.min(initial=np.inf)]
    if len(gaps) < _FEWEST or repeated < _FEWEST:
        return log, None
    multiples = np.round(gaps / gaps.min())
    step = float(np.median(gaps / multiples))
    regular = np.mean(abs(gaps / step - multiples) < _OFF) >= _MULTIPLES
    if not regular or step <= _NOTICED * np.median(deviations[np.isfinite(ranges)]):
        return log, None
    sigma = log.sigma.copy()
    sigma[:, log.layout.ranges] = np.hypot(deviations, step / np.sqrt(12.0))
    return replace(log, sigma=sigma), step


def clock_jumps(log: Log, sigma: Array) -> tuple[float, float] | None:
    """Return the share of epochs in which all ranges jump alike, and the median jump, m.

    The result is None if jumps are rare. ``sigma`` (T, rows) are standard deviations.
    """
    change = np.diff(_measured(log)[:, log.layout.ranges], axis=0)
    several = np.isfinite(change).sum(axis=1) >= 2
    if not several.any():
        return None
    change = change[several]
    usual = np.nanmedian(change, axis=1)
    apart = np.nanmax(abs(change - usual[:, None]), axis=1)
    noise = _JUMP_SIGMAS * np.nanmedian(sigma[:, log.layout.ranges])
    least = _FASTEST_MPS * np.diff(log.time_s)[several] + noise
    jumps = (abs(usual) > least) & (apart < _ALIKE * abs(usual))
    share = float(jumps.mean())
    return (share, float(np.median(abs(usual[jumps])))) if share >= _JUMPS else None


def noise_notes(
    reading: Reading, step_m: float | None, correlation_s: float = 0.0
) -> Iterator[str]:
    """Yield sentences on the noise of a log, whose ranges come in steps, and on what to do.

    A filter that knows for how long errors last, ``correlation_s``, needs no sentence on it.
    The noise of angles is that of the first epochs after errors that all links share are undone.
    If the clock jumps, nothing is said about other noise, which can't be told from the jumps.
    """
    jumps = clock_jumps(reading.log, reading.sigma)
    if jumps and reading.log.layout.clock != "free":
        share, jump_m = jumps
        yield (
            f"the user's clock jumps in {share:.0%} of the epochs, by {jump_m:.3g} m in the "
            "median: use --clock free, then diagnose the log again"
        )
        return
    if step_m:
        yield f"ranges come in steps of {step_m:.3g} m: localize adds the noise of rounding"
    with suppress(ValueError):  # no epoch determines a position, or the track is lost
        part = scanned(reading)
        if part:
            yield from _notes(without_errors(part, shared_errors(part)), correlation_s)
        else:
            yield _TOO_SHORT


def _notes(reading: Reading, correlation_s: float) -> Iterator[str]:
    """Yield sentences on the noise of a reading without errors."""
    log = reading.log
    sigma = reading.sigma
    z = _measured(log)
    apart = wrapped(z[:, AZIMUTH] - z[:, DEPARTURE] + np.pi)
    azimuths = apart / np.hypot(sigma[:, AZIMUTH], sigma[:, DEPARTURE])
    (w,) = innovations([reading])
    w = np.where(values_of(log), w, np.nan)
    scaled = []
    for name, columns, rows, values in (
        ("azimuths", "aoa_azimuth_sigma and aod_azimuth_sigma", AZIMUTH, azimuths),
        ("elevations", "aoa_elevation_sigma", ELEVATION, w[:, ELEVATION]),
        ("ranges", "range_sigma", RANGE, w[:, RANGE]),
    ):
        if np.isfinite(values).sum() < _ENOUGH:
            continue
        factor = float(np.nanmedian(abs(values))) / _MEDIAN
        if rows != RANGE:
            scaled.append(np.clip(values / factor, -_CLIPPED, _CLIPPED))
        if not _FACTORS[0] <= factor <= _FACTORS[1]:
            stated = np.isfinite(log.sigma[:, rows]).any()  # then the radio does not count
            other = f"give the log columns {columns}, or use another --radio"
            cure = f"correct {columns} in the log" if stated else other
            yield f"the noise of {name} is {factor:.2f} times as large as stated: {cure}"
    if scaled and not correlation_s:
        yield from _correlation(np.concatenate(scaled, axis=1), log.time_s)


def _correlation(values: Array, time_s: Array) -> Iterator[str]:
    """Yield a sentence if values (T, k), NaN where missing, are correlated in time."""
    products = [values[k:] * values[: len(values) - k] for k in range(_LAGS + 1)]
    covariance = [np.nansum(part) / max(np.isfinite(part).sum(), 1) for part in products]
    r = np.array(covariance[1:]) / covariance[0]
    decay = (r[1:] * r[:-1]).sum() / max((r[:-1] ** 2).sum(), 1e-9)
    if r[0] > _CORRELATED and 0.0 < decay < 1.0:
        seconds = -float(np.median(np.diff(time_s))) / np.log(decay)
        yield (
            f"errors of angles last about {seconds:.2g} s or more, so that standard deviations and "
            f"protection levels are too small: use --correlation {seconds:.2g}"
        )


def nearest_radio(log: Log, scene: Scene) -> str:
    """Return the name of the shipped profile whose standard deviations best match a log.

    The standard deviation of a measurement (such as the range) is the median of the values that the
    receiver states. If the receiver states none, the standard deviation is estimated from second
    differences in time, in which steady motion cancels. Then the log's standard deviations are
    divided by each profile's; the best profile has the smallest mean square of the logarithms of
    these ratios. If no standard deviation can be computed, the result is "handset".
    """
    measured = np.array([_deviation(log, row) for row in range(len(LINK))])
    if not np.isfinite(measured).any():
        return "handset"
    snr = log.snr_db[np.isfinite(log.snr_db)]
    snr_db = np.full((1, log.layout.anchors), np.median(snr) if len(snr) else NEUTRAL_SNR_DB)

    def distance(name: str) -> float:
        stated = RADIOS[name].sigma(snr_db, scene, log.layout)[0, : len(LINK)]
        return float(np.nanmean(np.log(measured / stated) ** 2))

    return min(RADIOS, key=distance)


def _deviation(log: Log, row: int) -> float:
    """Return the standard deviation (m or rad) of ``LINK[row]``; NaN if values are too few."""
    columns = slice(row, log.layout.doppler, len(LINK))
    own = log.sigma[:, columns]
    if np.isfinite(own).any():
        return float(np.nanmedian(own))
    change = np.diff(_measured(log)[:, columns], axis=0)
    second = np.diff(wrap(change) if row else change, axis=0)
    second = abs(second[np.isfinite(second)])
    if len(second) < _FEWEST_CHANGES:
        return np.nan
    return float(_ROBUST * np.median(second)) or np.nan  # values may change without any noise
