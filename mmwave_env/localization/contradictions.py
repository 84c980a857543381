"""Contradictions between a log and its scene, caused by wrong units, signs or frames.

A single row seldom shows a mistake. But over many rows, a mistake causes values that are impossible
or unlikely, or that do not fit the track that a filter computes from them. The limits are wide: at
most 10 of 1000 correct logs violate them (``tests/localization/test_contradictions.py``).
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.log_columns import RANGE_LIMITS_M, WIDEST_ELEVATION_DEG
from mmwave_env.models.envelope import STEP_S
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array

NIS_LIMITS = (0.2, 5.0)  # limits of the NIS per degree of freedom
SNR_LIMITS_DB = (-60.0, 90.0)
REJECTED_LIMIT = 1.0 / 3.0  # largest fraction of a group's measurements that gates may reject
_ENOUGH = 20  # minimum number of epochs for a conclusion
_ENOUGH_IF_BLOCKED = 100  # minimum number if a blockage of a few seconds may distort a conclusion
_WINDOW_S = 30.0  # length of a window of epochs, in which the oscillator's offset hardly changes
_MOST_APART_S = 3.0  # longest gap over which the Doppler shift is integrated
_SLOPE_LIMITS = (0.5, 1.5)  # limits of the slope: measured / predicted growth of the range
# A slope is reported only if it differs from 1 by more than this many standard errors. The number
# is large: standard errors assume independent range errors, but a blockage correlates the errors.
_SURE = 10.0


class Contradiction(NamedTuple):
    """A contradiction between a log and its scene, its radio or physical limits."""

    group: str  # name of a group of measurements (such as "anchor 1") or of a quantity ("time")
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.group}: found {self.found}, expected {self.expected}"


def contradictions(
    block: LogBlock, scene: Scene, radio: Radio, groups: Mapping[str, Mapping[str, Any]]
) -> list[Contradiction]:
    """Return all contradictions between a log and its scene, its radio or physical limits.

    ``block`` is the beginning of the log. ``groups`` maps the name of each group of measurements to
    its statistics: ``seen`` (number of epochs with it), ``rejected_share`` (fraction of these
    epochs in which a gate rejected it) and ``nis_per_dof``. ``track_scores.Groups`` computes them.
    """
    return [*impossible(block), *_oddities(block, scene, radio), *_misfits(groups)]


def _misfits(groups: Mapping[str, Mapping[str, Any]]) -> Iterator[Contradiction]:
    """Yield a contradiction for every group of measurements that does not fit the track."""
    for name, group in groups.items():
        if name == "all" or group["seen"] < _ENOUGH:
            continue
        nis = group["nis_per_dof"]
        share = group["rejected_share"]
        low, high = NIS_LIMITS
        # With large process noise, a filter predicts Doppler shift and odometry far better than its
        # covariance says. Even in correct logs, their NIS is often a tenth of the expected value.
        if not name.startswith("anchor"):
            low = 0.0
        if nis is not None and not low <= nis <= high:
            expected = f"{low:g} to {high:g}" if low else f"at most {high:g}"
            yield Contradiction(name, f"NIS / dof {nis:.3g}", expected)
        if group["seen"] >= _ENOUGH_IF_BLOCKED and share > REJECTED_LIMIT:
            yield Contradiction(name, f"{100.0 * share:.0f} % rejected", "at most a third")


def impossible(block: LogBlock) -> Iterator[Contradiction]:
    """Yield a contradiction for time steps, ranges and angles that no receiver can measure."""
    steps = np.diff(block.time_s)
    if len(steps) and (usual := np.median(steps)) > GAP_S:
        expected = f"at most {GAP_S:g} s: is the unit right?"
        yield Contradiction("time", f"epochs {usual:.3g} s apart", expected)
    elif len(steps) and not STEP_S.holds(shortest := float(steps.min())):
        yield Contradiction("time", f"epochs {shortest:.3g} s apart", STEP_S.expected)
    visible = block.visible[:, : block.layout.anchors]
    ranges = block.measurement[:, : block.layout.doppler : 4][visible]
    ranges = ranges[ranges > 0.0]
    least, most = RANGE_LIMITS_M
    if len(ranges) and not least <= np.median(ranges) <= most:
        yield Contradiction("range", f"{np.median(ranges):.3g} m", f"{least:g} to {most:g} m")
    for name, row in (("azimuth of arrival", 1), ("azimuth of departure", 3)):
        azimuths = abs(block.measurement[:, row : block.layout.doppler : 4][visible])
        if 2 * (azimuths > 2.0 * np.pi).sum() > np.isfinite(azimuths).sum():
            yield Contradiction(name, f"{np.nanmax(azimuths):.3g} rad", "up to 2 pi")
    elevations = np.degrees(abs(block.measurement[:, 2 : block.layout.doppler : 4][visible]))
    if 2 * (elevations > WIDEST_ELEVATION_DEG).sum() > np.isfinite(elevations).sum():
        expected = f"up to {WIDEST_ELEVATION_DEG:g}"
        yield Contradiction("elevation", f"{np.nanmax(elevations):.3g} degrees", expected)


def _oddities(block: LogBlock, scene: Scene, radio: Radio) -> Iterator[Contradiction]:
    """Yield a contradiction for values that are possible but unlikely, such as odd SNRs."""
    low, high = SNR_LIMITS_DB
    for anchor in range(block.layout.anchors):
        snr = block.snr_db[np.isfinite(block.snr_db[:, anchor]), anchor]
        if len(snr) and not low <= snr.min() <= snr.max() <= high:
            value = f"SNR of {snr.min():.3g} to {snr.max():.3g} dB"
            yield Contradiction(f"anchor {anchor + 1}", value, f"{low:g} to {high:g} dB")
    direct = block.visible[:, 0]
    if direct.sum() >= _ENOUGH:
        above = float((block.measurement[direct, 2] > 0.0).mean())
        if above > 0.5 + 1.5 / np.sqrt(direct.sum()):  # half plus three standard errors
            yield Contradiction(
                "anchor 1",
                f"a user above this anchor in {100.0 * above:.0f} % of epochs",
                "a user below this anchor (with negative elevations)",
            )
    slope, error = _range_per_doppler(block, scene, radio)
    if not _SLOPE_LIMITS[0] <= slope <= _SLOPE_LIMITS[1] and abs(slope - 1.0) > _SURE * error:
        value = f"a range that grows by {slope:.3g} m where the shift predicts 1 m"
        yield Contradiction("Doppler", value, "1 m: are the sign and the unit right?")


def _range_per_doppler(block: LogBlock, scene: Scene, radio: Radio) -> tuple[float, float]:
    """Return by how many meters the range grows where the Doppler shift predicts 1 m.

    Range and shift are those of anchor 1. Also return the standard error. The result is (1, inf) if
    epochs are too few or the user stands still. Ranges are regressed on a constant, time and the
    integrated shift. An offset of the oscillator makes ranges appear to grow with time; its prior,
    in ``radio``, limits the coefficient of time. Each window of 30 s has its own coefficients.
    """
    direct = block.visible[:, 0] & block.visible[:, block.layout.anchors]
    direct &= block.doppler_anchor == 0
    time = block.time_s[direct]
    z = block.measurement[direct]
    rate = z[:, block.layout.doppler] / scene.hz_per_mps
    sigma = radio.sigma(block.snr_db[direct], scene, block.layout)[:, 0]
    sums = np.zeros(4)
    for part in _windows(time):
        sums += _regression(
            time[part], z[part, 0], rate[part], float(np.median(sigma[part])), radio
        )
    dof, moved, product, square = sums.tolist()
    if dof < _ENOUGH_IF_BLOCKED or moved <= 0.0:
        return 1.0, float("inf")
    slope = product / moved
    misfit = max((square - slope * product) / dof, 1.0)
    return slope, float(np.sqrt(misfit / moved))


def _windows(time_s: Array) -> Iterator[slice]:
    """Yield slices of the epochs at times (T,): windows of at least 4 epochs without a long gap."""
    if not len(time_s):
        return
    gap = np.diff(time_s, prepend=time_s[:1]) > _MOST_APART_S
    within = np.floor((time_s - time_s[:1]) / _WINDOW_S)
    starts = np.flatnonzero(gap | (np.diff(within, prepend=-1.0) > 0.0))
    for first, end in zip(starts, [*starts[1:], len(time_s)], strict=True):
        if end - first > 3:
            yield slice(first, end)


def _regression(time_s: Array, range_m: Array, rate: Array, sigma: float, radio: Radio) -> Array:
    """Return [degrees of freedom, moved^2, moved * range, range^2] of a window.

    The last three are sums over epochs, divided by sigma^2. Their ``moved`` is the residual of a
    regression of the integral of ``rate`` on a constant and on time; their range, that of ranges.
    """
    time = time_s - time_s.mean()
    moved = np.cumsum(np.diff(time, prepend=time[0]) * 0.5 * (rate + np.roll(rate, 1)))
    moved -= moved.mean()
    ranges = range_m - range_m.mean()
    ridge = float(time @ time) + (sigma / radio.prior_bias_mps) ** 2

    def product(a: Array, b: Array) -> float:
        return float(a @ b - (a @ time) * (b @ time) / ridge) / sigma**2

    return np.array(
        [len(time) - 3, product(moved, moved), product(moved, ranges), product(ranges, ranges)]
    )
