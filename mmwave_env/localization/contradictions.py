"""Contradictions between a log and its scene, caused by wrong units, signs or frames.

A single row seldom shows a mistake. But over many rows, a mistake causes values that are impossible
or unlikely, or that do not fit the track that a filter computes from them. Each check
(:data:`Check`) compares a statistic of the log with its limits. The limits are wide: at most 10 of
1000 correct logs violate them (``tests/localization/test_contradictions.py``).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from math import inf
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.io.records import Bound
from mmwave_env.localization.starts import deviations_of
from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M, WIDEST_ELEVATION_DEG
from mmwave_env.models.envelope import STEP_S
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Array

_LARGEST_NIS = 5.0  # per degree of freedom
_FEW_WRONG = (
    0.85  # if more of the NIS are in their 95 % bounds, a large mean comes from a few links
)
_ENOUGH = 20  # minimum number of epochs for a conclusion
_ENOUGH_IF_BLOCKED = 100  # minimum number if a blockage of a few seconds may distort a conclusion
# minimum number if gates reject more than this share, as they seldom do in a blockage
_ENOUGH_IF_MOST = 50
_MOST = 0.8
_WINDOW_S = 30.0  # length of a window of epochs, in which the oscillator's offset hardly changes
_FEWEST = 4  # minimum number of epochs in a window
_MOST_APART_S = 3.0  # longest gap over which the Doppler shift is integrated
# limits of the slope: measured / predicted growth of the range
_LEAST_SLOPE = 0.5
_LARGEST_SLOPE = 1.5
# A slope is reported only if it differs from 1 by more than this many standard errors. The number
# is large: standard errors assume independent range errors, but a blockage correlates the errors.
_SURE = 10.0
_MOVED = 10.0  # difference of the deciles of ranges if a user moves, in standard deviations
_ROUNDING_M = 1e-6  # a known height varies by less
_TOO_LOW_M = 6.0  # depth below the streets and all anchors at which users are not expected
_SURE_SIGN = 5.0  # number of standard errors by which a slope must differ from 0 to count

_USUAL_STEP_S = Bound(f"at most {GAP_S:g} s: is the unit right?", most=GAP_S)
_SHORTEST_STEP_S = STEP_S._replace(most=inf)
_RANGE_M = Bound("0.001 to 1e+06 m", least=RANGE_LIMITS_M[0], most=RANGE_LIMITS_M[1])
_AZIMUTH = Bound("up to 2 pi", most=2.0 * PI)
_ELEVATION_DEG = Bound(f"up to {WIDEST_ELEVATION_DEG:g}", most=WIDEST_ELEVATION_DEG)
_SNR_DB = Bound("-60 to 90 dB", least=-60.0, most=90.0)
_NIS = Bound(f"0.2 to {_LARGEST_NIS:g}", least=0.2, most=_LARGEST_NIS)  # of anchors
_NIS_OF_OTHERS = Bound(f"at most {_LARGEST_NIS:g}", most=_LARGEST_NIS)
_REJECTED = Bound("at most a third", most=1.0 / 3.0)  # fraction that gates may reject


class Contradiction(NamedTuple):
    """A contradiction between a log and its scene, its radio or physical limits."""

    group: str  # name of a group of measurements (such as "anchor 1") or of a quantity ("time")
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.group}: found {self.found}, expected {self.expected}"


# A group, a statistic of it (a number, or an array of numbers that must all be within the bound),
# the bound, and what was found, in words.
Check = tuple[str, Any, Bound, str]


def contradictions(
    log: Log,
    scene: Scene,
    radio: Radio,
    groups: Mapping[str, Mapping[str, Any]],
    heights_m: Sequence[float] | Array = (0.0,),
    small_nis: bool = True,
) -> list[Contradiction]:
    """Return all contradictions between a log and its scene, its radio or physical limits.

    ``log`` is the beginning of the log. ``groups`` maps the name of each group of measurements to
    its statistics: ``seen`` (number of epochs with it), ``rejected_share`` (fraction of these
    epochs in which a gate rejected it) and ``nis_per_dof``. ``track_scores.group_statistics``
    computes them. ``heights_m`` are a track's heights; a known one does not vary. If ``small_nis``
    is False, a NIS that is too small is no contradiction.
    """
    checks = chain(_likelihood_checks(log, scene, radio, heights_m), _fit_checks(groups, small_nis))
    return impossible(log) + _failed(checks)


def impossible(log: Log) -> list[Contradiction]:
    """Return contradictions in time steps, ranges and angles that no receiver can measure."""
    return _failed(_physical_checks(log))


def _failed(checks: Iterable[Check]) -> list[Contradiction]:
    return [
        Contradiction(group, value, bound.expected)
        for group, statistic, bound, value in checks
        if not np.all(bound.holds(statistic) | np.isnan(statistic))
    ]


def _physical_checks(log: Log) -> Iterator[Check]:
    """Yield checks of values that can't be right in any scene."""
    steps = np.diff(log.time_s)
    if len(steps):
        for step, bound in ((np.median(steps), _USUAL_STEP_S), (steps.min(), _SHORTEST_STEP_S)):
            yield "time", step, bound, f"epochs {step:.3g} s apart"
    ranges, arrivals, elevations, departures = log.links[log.visible_links].T
    ranges = ranges[ranges > 0.0]
    if len(ranges):
        middle = np.median(ranges)
        yield "range", middle, _RANGE_M, f"{middle:.3g} m"
    for group, angles, bound, unit in (
        ("azimuth of arrival", arrivals, _AZIMUTH, "rad"),
        ("azimuth of departure", departures, _AZIMUTH, "rad"),
        ("elevation", np.degrees(elevations), _ELEVATION_DEG, "degrees"),
    ):
        sizes = np.sort(abs(angles[np.isfinite(angles)]))
        if len(sizes):
            middle = sizes[(len(sizes) - 1) // 2]  # beyond the bound if most sizes are
            yield group, middle, bound, f"{sizes[-1]:.3g} {unit}"


def _likelihood_checks(
    log: Log, scene: Scene, radio: Radio, heights_m: Sequence[float] | Array
) -> Iterator[Check]:
    """Yield checks of values that are possible but unlikely, such as odd SNRs."""
    for anchor, column in enumerate(log.snr_db.T, start=1):
        snr = column[np.isfinite(column)]
        if len(snr):
            value = f"SNR of {snr.min():.3g} to {snr.max():.3g} dB"
            yield f"anchor {anchor}", snr, _SNR_DB, value
    elevation = log.measurement[log.visible[:, 0], 2]
    elevation = elevation[np.isfinite(elevation)]
    if len(elevation) >= _ENOUGH:
        above = np.mean(elevation > 0.0)
        most = 0.5 + 1.5 / np.sqrt(len(elevation))  # a half plus three standard errors
        bound = Bound("a user below this anchor (with negative elevations)", most=most)
        value = f"a user above this anchor in {100.0 * above:.0f} % of epochs"
        yield "anchor 1", above, bound, value
    if np.ptp(heights_m) > _ROUNDING_M and not np.isfinite(log.links[..., 2]).any():
        # a clock that is ahead makes all ranges longer; a low user explains that, too
        lowest = min(scene.streets.height_m, *scene.anchors_m[:, 2])
        bound = Bound(
            f"about {scene.streets.height_m:g} m, the height of the scene's streets (--height if "
            "the ground is flat, --clock offset if the user's clock is its own)",
            least=lowest - _TOO_LOW_M,
        )
        usual = np.median(heights_m)
        yield "height", usual, bound, f"{usual:.3g} m by a track without elevations"
    slope, error = _range_per_doppler(log, scene, radio)
    bound = Bound(
        "1 m: are the sign and the unit right?",
        least=min(_LEAST_SLOPE, 1.0 - _SURE * error),
        most=max(_LARGEST_SLOPE, 1.0 + _SURE * error),
    )
    value = f"a range that grows by {slope:.3g} m where the shift predicts 1 m"
    yield "Doppler", slope, bound, value


def _fit_checks(groups: Mapping[str, Mapping[str, Any]], small_nis: bool) -> Iterator[Check]:
    """Yield checks of how well the groups of measurements fit the track."""
    for name, group in groups.items():
        if name == "all" or group["seen"] < _ENOUGH:
            continue
        nis = group["nis_per_dof"]
        # With large process noise, a filter predicts Doppler shift and odometry far better than its
        # covariance says. Even in correct logs, their NIS is often a tenth of the expected value.
        bound = _NIS if name.startswith("anchor") else _NIS_OF_OTHERS
        if (group.get("nis_in_bounds") or 0.0) >= _FEW_WRONG:
            bound = bound._replace(most=inf)  # such as reflections: that is no mistake
        if not small_nis:
            bound = bound._replace(least=None)
        if nis is not None:
            yield name, nis, bound, f"NIS / dof {nis:.3g}"
        share = group["rejected_share"]
        if group["seen"] >= (_ENOUGH_IF_MOST if share > _MOST else _ENOUGH_IF_BLOCKED):
            yield name, share, _REJECTED, f"{100.0 * share:.0f} % rejected"


def _range_per_doppler(log: Log, scene: Scene, radio: Radio) -> tuple[float, float]:
    """Return by how many meters the range grows where the Doppler shift predicts 1 m.

    Range and shift are those of anchor 1. Also return the standard error. The result is (1, inf) if
    epochs are too few, the user stands still or the clock jumps; it is (inf, 0) if the shift never
    changes although the user moves. Ranges are regressed on a constant, time and the integrated
    shift. An offset of the oscillator makes ranges appear to grow with time; its prior, in
    ``radio``, limits the coefficient of time. Each window of 30 s has its own coefficients.

    Noise of the shift makes this slope too small, noise of the range makes the slope of the reverse
    regression too large. Of the slopes between both, the result is the one nearest to 1.
    """
    direct = log.visible[:, 0] & log.visible[:, log.layout.anchors] & (log.doppler_anchor == 0)
    known = np.isfinite(log.measurement[:, [0, log.layout.doppler]]).all(axis=1)
    log = log.part(direct & known)
    time = log.time_s
    rate = log.measurement[:, log.layout.doppler] / scene.hz_per_mps
    sigma = deviations_of(log, scene, radio)[:, 0]
    # windows without a long gap
    window = np.floor((time - time[:1]) / _WINDOW_S)
    edges = np.flatnonzero((np.diff(time) > _MOST_APART_S) | (np.diff(window) > 0.0)) + 1
    dof = 0
    products = np.zeros((2, 2))
    for part in np.split(np.arange(len(time)), edges):
        if len(part) >= _FEWEST:
            usual = float(np.median(sigma[part]))
            products += _products(time[part], log.measurement[part, 0], rate[part], usual, radio)
            dof += len(part) - 3
    (moved, product), (_, square) = products.tolist()
    if dof < _ENOUGH_IF_BLOCKED or log.layout.clock == "free":
        return 1.0, inf
    if np.ptp(rate) == 0.0:  # nothing was measured, if the range of most epochs varies
        low, high = np.percentile(log.measurement[:, 0], [10, 90])
        return (inf, 0.0) if high - low > _MOVED * np.median(sigma) else (1.0, inf)
    if moved <= 0.0:
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
