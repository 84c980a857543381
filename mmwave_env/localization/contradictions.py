"""Contradictions between a log and its scene, caused by wrong units, signs or frames.

A single row seldom shows a mistake. But over many rows, a mistake causes values that are impossible
or unlikely, or that do not fit the track that a filter computes from them. The limits are wide: at
most 10 of 1000 correct logs violate them (``tests/localization/test_contradictions.py``).
"""

from collections.abc import Iterator, Mapping
from math import inf
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import Log
from mmwave_env.logs.log_columns import RANGE_LIMITS_M, WIDEST_ELEVATION_DEG
from mmwave_env.models.envelope import STEP_S
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI

NIS_LIMITS = (0.2, 5.0)  # limits of the NIS per degree of freedom
SNR_LIMITS_DB = (-60.0, 90.0)
FEW_WRONG = 0.85  # if more of the NIS are in their 95 % bounds, a large mean comes from a few links
REJECTED_LIMIT = 1.0 / 3.0  # largest fraction of a group's measurements that gates may reject
_ENOUGH = 20  # minimum number of epochs for a conclusion
_ENOUGH_IF_BLOCKED = 100  # minimum number if a blockage of a few seconds may distort a conclusion
_WINDOW_S = 30.0  # length of a window of epochs, in which the oscillator's offset hardly changes
_FEWEST = 4  # minimum number of epochs in a window
_MOST_APART_S = 3.0  # longest gap over which the Doppler shift is integrated
_SLOPE_TOLERANCE = 0.5  # of the slope, measured / predicted growth of the range, around 1
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


def contradictions(
    log: Log, scene: Scene, radio: Radio, groups: Mapping[str, Mapping[str, Any]]
) -> list[Contradiction]:
    """Return all contradictions between a log and its scene, its radio or physical limits.

    ``log`` is the beginning of the log. ``groups`` maps the name of each group of measurements to
    its statistics: ``seen`` (number of epochs with it), ``rejected_share`` (fraction of these
    epochs in which a gate rejected it) and ``nis_per_dof``. ``track_scores.Groups`` computes them.
    """
    return [*impossible(log), *_unlikely(log, scene, radio), *_misfits(groups)]


def impossible(log: Log) -> Iterator[Contradiction]:
    """Yield contradictions in time steps, ranges and angles that no receiver can measure."""
    steps = np.diff(log.time_s)
    if len(steps):
        usual = np.median(steps)
        if not 0.0 <= usual <= GAP_S:
            expected = f"at most {GAP_S:g} s: is the unit right?"
            yield Contradiction("time", f"epochs {usual:.3g} s apart", expected)
        shortest = steps.min()
        if shortest < (STEP_S.least or 0.0):
            yield Contradiction("time", f"epochs {shortest:.3g} s apart", STEP_S.expected)
    visible = log.visible[:, : log.layout.anchors]
    links = log.measurement[:, : log.layout.doppler].reshape(*visible.shape, 4)[visible]
    ranges, arrivals, elevations, departures = links.T
    ranges = ranges[ranges > 0.0]
    if len(ranges):
        low, high = RANGE_LIMITS_M
        middle = np.median(ranges)
        if not low <= middle <= high:
            yield Contradiction("range", f"{middle:.3g} m", f"{low:g} to {high:g} m")
    widest = f"up to {WIDEST_ELEVATION_DEG:g}"
    for group, angles, limit, unit, expected in (
        ("azimuth of arrival", arrivals, 2.0 * PI, "rad", "up to 2 pi"),
        ("azimuth of departure", departures, 2.0 * PI, "rad", "up to 2 pi"),
        ("elevation", np.degrees(elevations), WIDEST_ELEVATION_DEG, "degrees", widest),
    ):
        sizes = np.sort(abs(angles[np.isfinite(angles)]))
        if len(sizes) and sizes[(len(sizes) - 1) // 2] > limit:  # most sizes are
            yield Contradiction(group, f"{sizes[-1]:.3g} {unit}", expected)


def _unlikely(log: Log, scene: Scene, radio: Radio) -> Iterator[Contradiction]:
    """Yield contradictions in values that are possible but unlikely, such as odd SNRs."""
    low, high = SNR_LIMITS_DB
    for anchor, column in enumerate(log.snr_db.T, start=1):
        snr = column[np.isfinite(column)]
        if ((snr < low) | (snr > high)).any():
            value = f"SNR of {snr.min():.3g} to {snr.max():.3g} dB"
            yield Contradiction(f"anchor {anchor}", value, f"{low:g} to {high:g} dB")
    elevation = log.measurement[log.visible[:, 0], 2]
    if len(elevation) >= _ENOUGH:
        above = np.mean(elevation > 0.0)
        if above > 0.5 + 1.5 / np.sqrt(len(elevation)):  # a half plus three standard errors
            value = f"a user above this anchor in {100.0 * above:.0f} % of epochs"
            expected = "a user below this anchor (with negative elevations)"
            yield Contradiction("anchor 1", value, expected)
    slope, error = _range_per_doppler(log, scene, radio)
    if abs(slope - 1.0) > max(_SLOPE_TOLERANCE, _SURE * error):
        value = f"a range that grows by {slope:.3g} m where the shift predicts 1 m"
        yield Contradiction("Doppler", value, "1 m: are the sign and the unit right?")


def _misfits(groups: Mapping[str, Mapping[str, Any]]) -> Iterator[Contradiction]:
    """Yield contradictions of the groups of measurements that do not fit the track."""
    for name, group in groups.items():
        if name == "all" or group["seen"] < _ENOUGH:
            continue
        low, high = NIS_LIMITS
        expected = f"{low:g} to {high:g}"
        # With large process noise, a filter predicts Doppler shift and odometry far better than its
        # covariance says. Even in correct logs, their NIS is often a tenth of the expected value.
        if not name.startswith("anchor"):
            low = 0.0
            expected = f"at most {high:g}"
        if (group.get("nis_in_bounds") or 0.0) >= FEW_WRONG:
            high = inf  # a few links are wrong, such as reflections: that is no mistake
        nis = group["nis_per_dof"]
        if nis is not None and (nis < low or nis > high):
            yield Contradiction(name, f"NIS / dof {nis:.3g}", expected)
        share = group["rejected_share"]
        if group["seen"] >= _ENOUGH_IF_BLOCKED and share > REJECTED_LIMIT:
            yield Contradiction(name, f"{100.0 * share:.0f} % rejected", "at most a third")


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
    moved = np.cumsum(np.diff(time, prepend=time[:1]) * 0.5 * (rate + np.roll(rate, 1)))
    columns = np.stack([moved, z[:, 0], time])
    sigma = radio.sigma(log.snr_db[direct], scene, log.layout)[:, 0]
    # windows without a long gap
    window = np.floor((time - time[:1]) / _WINDOW_S)
    edges = np.flatnonzero((np.diff(time) > _MOST_APART_S) | (np.diff(window) > 0.0)) + 1
    dof = 0
    products = np.zeros((2, 2))
    for part in np.split(np.arange(len(time)), edges):
        if len(part) >= _FEWEST:
            values = columns[:, part] - columns[:, part].mean(axis=1, keepdims=True)
            scatter = values @ values.T
            usual = np.median(sigma[part])
            along = scatter[:2, 2]
            ridge = scatter[2, 2] + (usual / radio.prior_bias_mps) ** 2
            products += (scatter[:2, :2] - np.outer(along, along) / ridge) / usual**2
            dof += len(part) - 3
    (moved_m2, product), (_, square) = products.tolist()
    if dof < _ENOUGH_IF_BLOCKED or moved_m2 <= 0.0:
        return 1.0, inf
    slope = product / moved_m2
    misfit = max((square - slope * product) / dof, 1.0)
    error = float(np.sqrt(misfit / moved_m2))
    if abs(slope) < _SURE_SIGN * error:
        return 1.0, inf
    if 0.0 < slope < 1.0:
        slope = min(square / product, 1.0)
    return slope, error
