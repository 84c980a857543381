"""Where a log contradicts its scene: what a mistaken unit, sign or frame leaves in the numbers.

Most mistakes can't be seen in a row, but a track that is made of them does not fit, or its
geometry is not of this world. The limits are wide: of 1000 right logs at most 10 are doubted
(``tests/localization/test_contradictions.py``).
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.log_checks import RANGE_LIMITS_M, WIDEST_DEG
from mmwave_env.models.envelope import STEP_S
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array

NIS_LIMITS = (0.2, 5.0)  # per degree of freedom
SNR_LIMITS_DB = (-60.0, 90.0)
REJECTED_LIMIT = 1.0 / 3.0
_ENOUGH = 20  # epochs; fewer tell nothing
_ENOUGH_IF_BLOCKED = 100  # where errors last, because a link is blocked for seconds
_WINDOW_S = 30.0  # over which the oscillator's offset hardly moves
_MOST_APART_S = 3.0  # epochs between which the Doppler shift may be integrated
_SLOPE_LIMITS = (0.5, 1.5)
_SURE = 10.0  # standard errors; errors of a blocked link last, so they are not independent


class Contradiction(NamedTuple):
    """What a log says that its scene, its radio or the world does not."""

    group: str  # of measurements, or another quantity
    found: str
    expected: str

    def __str__(self) -> str:
        return f"{self.group}: found {self.found}, expected {self.expected}"


def contradictions(
    block: LogBlock, scene: Scene, radio: Radio, groups: Mapping[str, Mapping[str, Any]]
) -> list[Contradiction]:
    """Whatever contradicts a log.

    Args:
        block: its first epochs.
        scene, radio: what they are said to be measured in, and with.
        groups: how the measurements fared on a track, by name: ``seen``, ``rejected_share`` and
            ``nis_per_dof``, as :meth:`~mmwave_env.localization.track_scores.Groups.figures`
            gives them.
    """
    return [*impossible(block), *_oddities(block, scene, radio), *_misfits(groups)]


def _misfits(groups: Mapping[str, Mapping[str, Any]]) -> Iterator[Contradiction]:
    """Groups that do not fit a track."""
    for name, group in groups.items():
        if name == "all" or group["seen"] < _ENOUGH:
            continue
        nis, share = group["nis_per_dof"], group["rejected_share"]
        low, high = NIS_LIMITS
        # A filter that trusts its own velocity little predicts the Doppler shift, and odometry,
        # far better than it claims: on right logs their NIS is often a tenth of what it should be.
        if not name.startswith("anchor"):
            low = 0.0
        if nis is not None and not low <= nis <= high:
            expected = f"{low:g} to {high:g}" if low else f"at most {high:g}"
            yield Contradiction(name, f"NIS / dof {nis:.3g}", expected)
        if group["seen"] >= _ENOUGH_IF_BLOCKED and share > REJECTED_LIMIT:
            yield Contradiction(name, f"{100.0 * share:.0f} % rejected", "at most a third")


def impossible(block: LogBlock) -> Iterator[Contradiction]:
    """What no track can be made of: steps, ranges and elevations that there can't be."""
    step = float(np.median(np.diff(block.time_s))) if len(block) > 1 else 0.0
    if step > GAP_S:
        yield Contradiction(
            "time", f"epochs {step:.3g} s apart", f"at most {GAP_S:g} s: is its unit right?"
        )
    elif len(block) > 1 and not STEP_S.holds(np.diff(block.time_s).min()):
        yield Contradiction("time", f"epochs {step:.3g} s apart", STEP_S.expected)
    visible = block.visible[:, : block.layout.anchors]
    ranges = block.measurement[:, : block.layout.doppler : 4][visible]
    ranges = ranges[ranges > 0.0]
    least, most = RANGE_LIMITS_M
    if len(ranges) and not least <= np.median(ranges) <= most:
        yield Contradiction("range", f"{np.median(ranges):.3g} m", f"{least:g} to {most:g} m")
    elevations = np.degrees(abs(block.measurement[:, 2 : block.layout.doppler : 4][visible]))
    limit = WIDEST_DEG["aoa_elevation"]
    if (elevations > limit).mean() > 0.5:
        yield Contradiction("elevation", f"{elevations.max():.3g} degrees", f"up to {limit:g}")


def _oddities(block: LogBlock, scene: Scene, radio: Radio) -> Iterator[Contradiction]:
    """What can be, but hardly is: a user above the base station, an SNR or a Doppler shift."""
    low, high = SNR_LIMITS_DB
    for anchor in range(block.layout.anchors):
        snr = block.snr_db[np.isfinite(block.snr_db[:, anchor]), anchor]
        if len(snr) and not low <= snr.min() <= snr.max() <= high:
            found = f"SNR of {snr.min():.3g} to {snr.max():.3g} dB"
            yield Contradiction(f"anchor {anchor + 1}", found, f"{low:g} to {high:g} dB")
    direct = block.visible[:, 0]
    if direct.sum() >= _ENOUGH:
        above = float((block.measurement[direct, 2] > 0.0).mean())
        if above > 0.5 + 1.5 / np.sqrt(direct.sum()):  # three standard errors: one may be far off
            yield Contradiction(
                "anchor 1",
                f"the user above it in {100.0 * above:.0f} % of epochs",
                "below: a negative elevation",
            )
    slope, error = _range_per_doppler(block, scene, radio)
    if not _SLOPE_LIMITS[0] <= slope <= _SLOPE_LIMITS[1] and abs(slope - 1.0) > _SURE * error:
        found = f"a range that grows by {slope:.3g} m where the shift says 1 m"
        yield Contradiction("Doppler", found, "1 m: are sign and unit right?")


def _range_per_doppler(block: LogBlock, scene: Scene, radio: Radio) -> tuple[float, float]:
    """Change of the range of anchor 1 per meter by the Doppler shift, and its standard error.

    Ranges of windows are regressed on the integral of the shift, next to a constant and to the
    oscillator's offset times time, of which the radio's prior is known. It is 1 where sign and
    unit are right. (1, inf) where nothing moves.
    """
    direct = block.visible[:, 0] & block.visible[:, block.layout.anchors]
    time, z = block.time_s[direct], block.measurement[direct]
    rate = z[:, block.layout.doppler] / scene.hz_per_mps
    sigma = radio.sigma(block.snr_db[direct], scene, block.layout)[:, 0]
    sums = np.zeros(4)
    for part in _windows(time):
        sums += _regression(
            time[part], z[part, 0], rate[part], float(np.median(sigma[part])), radio
        )
    spare, over, product, square = sums.tolist()
    if spare < _ENOUGH_IF_BLOCKED or over <= 0.0:
        return 1.0, float("inf")
    slope = product / over
    misfit = max((square - slope * product) / spare, 1.0)
    return slope, float(np.sqrt(misfit / over))


def _windows(time_s: Array) -> Iterator[slice]:
    """Consecutive epochs (T,) in windows without gaps."""
    gap = np.diff(time_s, prepend=time_s[:1]) > _MOST_APART_S
    within = np.floor((time_s - time_s[:1]) / _WINDOW_S)
    starts = np.flatnonzero(gap | (np.diff(within, prepend=-1.0) > 0.0))
    for first, end in zip(starts, [*starts[1:], len(time_s)], strict=True):
        if end - first > 3:
            yield slice(first, end)


def _regression(time_s: Array, range_m: Array, rate: Array, sigma: float, radio: Radio) -> Array:
    """Spare degrees of freedom and the three products of a window's regression, over sigma^2."""
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
