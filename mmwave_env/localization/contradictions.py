"""Contradictions between a log and its scene, caused by wrong units, signs or frames.

A single row seldom shows a mistake. But over many rows, a mistake causes values that are impossible
or unlikely, or that do not fit the track that a filter computes from them. Each row of a table
(:class:`Check`) compares a statistic of the log with its limits. The limits are wide: at most 10 of
1000 correct logs violate them (``tests/localization/test_contradictions.py``).
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from math import inf
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M, WIDEST_ELEVATION_DEG
from mmwave_env.models.envelope import STEP_S
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Array

NIS_LIMITS = (0.2, 5.0)  # limits of the NIS per degree of freedom
SNR_LIMITS_DB = (-60.0, 90.0)
FEW_WRONG = 0.85  # if more of the NIS are in their 95 % bounds, a large mean comes from a few links
REJECTED_LIMIT = 1.0 / 3.0  # largest fraction of a group's measurements that gates may reject
_ENOUGH = 20  # minimum number of epochs for a conclusion
_ENOUGH_IF_BLOCKED = 100  # minimum number if a blockage of a few seconds may distort a conclusion
_WINDOW_S = 30.0  # length of a window of epochs, in which the oscillator's offset hardly changes
_FEWEST = 4  # minimum number of epochs in a window
_MOST_APART_S = 3.0  # longest gap over which the Doppler shift is integrated
_SLOPE_LIMITS = (0.5, 1.5)  # limits of the slope: measured / predicted growth of the range
# A slope is reported only if it differs from 1 by more than this many standard errors. The number
# is large: standard errors assume independent range errors, but a blockage correlates the errors.
_SURE = 10.0
_SURE_SIGN = 5.0  # number of standard errors by which a slope must differ from 0 to count


class Contradiction(NamedTuple):
    """A contradiction between a log and its scene, its radio or physical limits."""

    group: str  # name of a group of measurements (such as "anchor 1") or of a quantity ("time")
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.group}: found {self.found}, expected {self.expected}"


class Check(NamedTuple):
    """A statistic of a log, its limits, and the words of the contradiction if it is beyond them."""

    group: str
    statistic: Any  # a number, or an array of numbers that must all be within the limits
    limits: tuple[float, float]
    found: str
    expected: str


def contradictions(
    log: Log, scene: Scene, radio: Radio, groups: Mapping[str, Mapping[str, Any]]
) -> list[Contradiction]:
    """Return all contradictions between a log and its scene, its radio or physical limits.

    ``log`` is the beginning of the log. ``groups`` maps the name of each group of measurements to
    its statistics: ``seen`` (number of epochs with it), ``rejected_share`` (fraction of these
    epochs in which a gate rejected it) and ``nis_per_dof``. ``track_scores.Groups`` computes them.
    """
    checks = chain(_likelihood_checks(log, scene, radio), _fit_checks(groups))
    return impossible(log) + _failed(checks)


def impossible(log: Log) -> list[Contradiction]:
    """Return contradictions in time steps, ranges and angles that no receiver can measure."""
    return _failed(_physical_checks(log))


def _failed(checks: Iterable[Check]) -> list[Contradiction]:
    return [
        Contradiction(group, value, expected)
        for group, statistic, (low, high), value, expected in checks
        if np.any((statistic < low) | (statistic > high))
    ]


def _physical_checks(log: Log) -> Iterator[Check]:
    """Yield checks of values that can't be right in any scene."""
    steps = np.diff(log.time_s)
    if len(steps):
        usual = np.median(steps)
        expected = f"at most {GAP_S:g} s: is the unit right?"
        yield Check("time", usual, (0.0, GAP_S), f"epochs {usual:.3g} s apart", expected)
        shortest = steps.min()
        value = f"epochs {shortest:.3g} s apart"
        yield Check("time", shortest, (STEP_S.least or 0.0, inf), value, STEP_S.expected)
    visible = log.visible[:, : log.layout.anchors]
    links = log.measurement[:, : log.layout.doppler].reshape(*visible.shape, 4)[visible]
    ranges, arrivals, elevations, departures = links.T
    ranges = ranges[ranges > 0.0]
    if len(ranges):
        low, high = RANGE_LIMITS_M
        middle = np.median(ranges)
        yield Check("range", middle, (low, high), f"{middle:.3g} m", f"{low:g} to {high:g} m")
    widest = f"up to {WIDEST_ELEVATION_DEG:g}"
    for group, angles, limit, unit, expected in (
        ("azimuth of arrival", arrivals, 2.0 * PI, "rad", "up to 2 pi"),
        ("azimuth of departure", departures, 2.0 * PI, "rad", "up to 2 pi"),
        ("elevation", np.degrees(elevations), WIDEST_ELEVATION_DEG, "degrees", widest),
    ):
        sizes = np.sort(abs(angles[np.isfinite(angles)]))
        if len(sizes):
            middle = sizes[(len(sizes) - 1) // 2]  # beyond the limit if most sizes are
            yield Check(group, middle, (0.0, limit), f"{sizes[-1]:.3g} {unit}", expected)


def _likelihood_checks(log: Log, scene: Scene, radio: Radio) -> Iterator[Check]:
    """Yield checks of values that are possible but unlikely, such as odd SNRs."""
    low, high = SNR_LIMITS_DB
    for anchor, column in enumerate(log.snr_db.T, start=1):
        snr = column[np.isfinite(column)]
        if len(snr):
            value = f"SNR of {snr.min():.3g} to {snr.max():.3g} dB"
            yield Check(f"anchor {anchor}", snr, (low, high), value, f"{low:g} to {high:g} dB")
    elevation = log.measurement[log.visible[:, 0], 2]
    if len(elevation) >= _ENOUGH:
        above = np.mean(elevation > 0.0)
        most = 0.5 + 1.5 / np.sqrt(len(elevation))  # a half plus three standard errors
        value = f"a user above this anchor in {100.0 * above:.0f} % of epochs"
        expected = "a user below this anchor (with negative elevations)"
        yield Check("anchor 1", above, (0.0, most), value, expected)
    slope, error = _range_per_doppler(log, scene, radio)
    low, high = _SLOPE_LIMITS
    limits = (min(low, 1.0 - _SURE * error), max(high, 1.0 + _SURE * error))
    value = f"a range that grows by {slope:.3g} m where the shift predicts 1 m"
    yield Check("Doppler", slope, limits, value, "1 m: are the sign and the unit right?")


def _fit_checks(groups: Mapping[str, Mapping[str, Any]]) -> Iterator[Check]:
    """Yield checks of how well the groups of measurements fit the track."""
    for name, group in groups.items():
        if name == "all" or group["seen"] < _ENOUGH:
            continue
        nis = group["nis_per_dof"]
        low, high = NIS_LIMITS
        expected = f"{low:g} to {high:g}"
        if (group.get("nis_in_bounds") or 0.0) >= FEW_WRONG:
            high = inf  # a few links are wrong, such as reflections: that is no mistake
        # With large process noise, a filter predicts Doppler shift and odometry far better than its
        # covariance says. Even in correct logs, their NIS is often a tenth of the expected value.
        if not name.startswith("anchor"):
            low = 0.0
            expected = f"at most {high:g}"
        if nis is not None:
            yield Check(name, nis, (low, high), f"NIS / dof {nis:.3g}", expected)
        if group["seen"] >= _ENOUGH_IF_BLOCKED:
            share = group["rejected_share"]
            value = f"{100.0 * share:.0f} % rejected"
            yield Check(name, share, (0.0, REJECTED_LIMIT), value, "at most a third")


def _range_per_doppler(log: Log, scene: Scene, radio: Radio) -> tuple[float, float]:
    """Return by how many meters the range grows where the Doppler shift predicts 1 m.

    Range and shift are those of anchor 1. Also return the standard error. The result is (1, inf) if
    epochs are too few or the user stands still. Ranges are regressed on a constant, time and the
    integrated shift. An offset of the oscillator makes ranges appear to grow with time; its prior,
    in ``radio``, limits the coefficient of time. Each window of 30 s has its own coefficients.

    Noise of the shift makes this slope too small, noise of the range makes the slope of the reverse
    regression too large. Of the slopes between both, the result is the one nearest to 1.
    """
    direct = log.visible[:, 0] & log.visible[:, log.layout.anchors]
    direct &= log.doppler_anchor == 0
    time = log.time_s[direct]
    z = log.measurement[direct]
    rate = z[:, log.layout.doppler] / scene.hz_per_mps
    sigma = radio.sigma(log.snr_db[direct], scene, log.layout)[:, 0]
    # windows without a long gap
    window = np.floor((time - time[:1]) / _WINDOW_S)
    edges = np.flatnonzero((np.diff(time) > _MOST_APART_S) | (np.diff(window) > 0.0)) + 1
    dof = 0
    products = np.zeros((2, 2))
    for part in np.split(np.arange(len(time)), edges):
        if len(part) >= _FEWEST:
            usual = float(np.median(sigma[part]))
            products += _products(time[part], z[part, 0], rate[part], usual, radio)
            dof += len(part) - 3
    (moved, product), (_, square) = products.tolist()
    if dof < _ENOUGH_IF_BLOCKED or moved <= 0.0:
        return 1.0, inf
    slope = product / moved
    misfit = max((square - slope * product) / dof, 1.0)
    error = float(np.sqrt(misfit / moved))
    if abs(slope) < _SURE_SIGN * error:
        return 1.0, inf
    if 0.0 < slope < 1.0:
        slope = min(square / product, 1.0)
    return slope, error


def _products(time_s: Array, range_m: Array, rate: Array, sigma: float, radio: Radio) -> Array:
    """Return the products (2, 2) of the movement and the ranges in a window, divided by sigma^2.

    The movement is the integral of ``rate``. A product is a sum over epochs. The parts of its
    factors that are constant or grow with time are removed first, by a regression.
    """
    time = time_s - time_s.mean()
    moved = np.cumsum(np.diff(time, prepend=time[0]) * 0.5 * (rate + np.roll(rate, 1)))
    values: Array = np.stack([moved - moved.mean(), range_m - range_m.mean()])
    along = values @ time
    ridge = float(time @ time) + (sigma / radio.prior_bias_mps) ** 2
    return (values @ values.T - np.outer(along, along) / ridge) / sigma**2
