"""Scores of a track against true positions; statistics of its measurements, speeds and modes."""

import warnings
from collections.abc import Sequence

import numpy as np

from mmwave_env.filters.belief import Belief
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.io.files import Json
from mmwave_env.localization.localizer import Track
from mmwave_env.localization.position_errors import PositionErrors
from mmwave_env.logs.log import Log
from mmwave_env.logs.truth import Truth
from mmwave_env.metrics import RISK, nees_interval, running_summary, sums_of
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array, Index, Mask

FAR_NEES = 100.0  # a larger mean NEES means that the track is far from the true positions
_ENOUGH = 100  # number of epochs that are used to estimate the time step


def ratio(part: float, whole: float) -> float | None:
    """Return part / whole; None if the whole is zero."""
    return float(part / whole) if whole else None


def truth_scores(track: Track, truth: Truth, names: Sequence[str], risk: float = RISK) -> Json:
    """Return the accuracy of tracks against true positions, with values to compare it with.

    :mod:`mmwave_env.metrics` defines ATE, RMSE, RPE and NEES. If less than half of the epochs have
    a true position, there is a warning.

    Args:
        track: the track.
        truth: the true positions.
        names: the tracks to score: "filtered", "smoothed" or both.
        risk: risk of the protection levels.

    Raises:
        ValueError: no epoch has a true position.
    """
    position = truth.at(track.time_s)
    known = np.flatnonzero(~np.isnan(position[:, 0]))
    truth.require_match(len(known), track.time_s)
    axes = (0, 1) if track.planar else (0, 1, 2)
    pairs, apart_s = _pairs(track.time_s[known], track.segment[known], track.time_s[:_ENOUGH])
    where = list(position[known].T)
    rows: Json = {}
    for name in names:
        x = (track.smooth_x if name == "smoothed" else track.x)[known]
        P = (track.smooth_P if name == "smoothed" else track.P)[known]
        covariance = unpack(list(P.T), zero=VERTICAL if track.planar else ())
        belief = Belief(list(x.T), covariance, axes)
        error = np.column_stack(belief.error(where))
        errors = PositionErrors(risk, track.planar)
        errors.add(error, P, track.level_factors[known])
        change = error[pairs[:, 1]] - error[pairs[:, 0]]
        sums = sums_of(error, np.asarray(belief.nees(where)), change, len(axes))
        rows[name] = {metric: float(value) for metric, value in running_summary(sums).items()}
        del rows[name]["divergence_rate"]
        if not len(pairs):
            rows[name]["rpe_m"] = None
        rows[name] |= errors.figures()
    return {
        "scored": len(known),
        "rpe_s": apart_s if len(pairs) else None,
        "nees_expected": len(axes),
        "nees_interval": nees_interval(len(axes)),
        "risk": risk,
        "tracks": rows,
    }


def warn_if_far(truth: Truth, scores: Json) -> None:
    """Warn if the true positions are far from the filtered beliefs, given a track's scores."""
    nees = scores["tracks"]["filtered"]["nees"]
    if not nees <= FAR_NEES:
        warnings.warn(
            f"{truth.path}: found a mean NEES of {nees:.3g}, expected about "
            f"{scores['nees_expected']}: is this file in m, in the scene's frame (x east, y north) "
            "and from the same drive, and are the scene's anchors right? If so, the filter failed",
            stacklevel=2,
        )


def _pairs(time_s: Array, segment: Index, first_s: Array) -> tuple[Index, float | None]:
    """Pair scored epochs (n,) that are a second apart, or one time step if steps are longer.

    Return indices (pairs, 2) of the earlier and the later epochs, and the time (s) between them:
    the multiple of the time step that is nearest to a second, or None if epochs are too few. Epochs
    of different segments are not paired. The time step is estimated from the times ``first_s``.
    """
    if len(first_s) < 2:
        return np.empty((0, 2), np.int64), None
    step = float(np.median(np.diff(first_s)))
    apart_s = max(1, round(1.0 / step)) * step
    later = time_s + apart_s
    first = np.arange(len(time_s))
    second = np.floor(np.interp(later, time_s, first) + 0.5).astype(np.int64)  # the nearest epochs
    paired = (np.abs(time_s[second] - later) <= 0.5 * step) & (second > first)
    paired &= segment[second] == segment
    return np.column_stack([first, second])[paired], apart_s


def group_statistics(log: Log, accepted: Mask, nis: Array) -> dict[str, dict[str, float | None]]:
    """Return counts, rejections and innovations of each group of measurements, and of "all".

    Args:
        log: T epochs, in which the groups that a filter used are visible.
        accepted: (T, groups) whether the filter's gate accepted the group.
        nis: (T, groups) the filter's NIS; 0 where not visible.
    """
    layout = log.layout
    visible = log.visible
    measured = np.isfinite(log.measurement)
    rows = np.add.reduceat(measured, layout.starts, axis=1, dtype=np.int64)
    low, high = np.array([nees_interval(max(n, 1)) for n in range(5)]).T[:, rows]
    counted = (
        visible,
        visible & ~accepted,
        log.incomplete,
        accepted * rows,
        accepted * nis,
        accepted & (nis >= low) & (nis <= high),
    )
    sums = np.array([part.sum(axis=0) for part in counted], float)
    columns = [*sums.T, sums.sum(axis=1)]
    return {
        name: {
            "seen": int(visible),
            "rejected": int(rejected),
            "rejected_share": ratio(rejected, visible),
            "incomplete": int(incomplete),
            "nis_per_dof": ratio(nis, dof),
            "nis_in_bounds": ratio(bounded, visible - rejected),
        }
        for name, (visible, rejected, incomplete, dof, nis, bounded) in zip(
            [*layout.group_names, "all"], columns, strict=True
        )
    }


def track_statistics(track: Track) -> Json:
    """Return the times, the speeds and the modes of a track, and its expected errors."""
    speed = np.linalg.norm(track.x[:, 3:6], axis=1)
    xx, yy, zz = track.smooth_P[:, [0, 2, 5]].mean(axis=0)
    counts = np.bincount(track.mode, minlength=len(track.modes))
    more: Json = {}
    if track.layout.clock == "offset":
        deviation = float(np.sqrt(track.P[-1, 35]))
        more["clock"] = {"range_bias_m": float(track.x[-1, 7]), "deviation_m": deviation}
    for name, trusted in (("trusted", track.trusted), ("smooth_trusted", track.smooth_trusted)):
        if np.isfinite(trusted).all():
            more[name] = float(trusted.mean())
    return {
        "epochs": len(track),
        "skipped": track.skipped,
        "restarts": int(track.segment[-1]),
        "restarted_s": track.time_s[1:][np.diff(track.segment) > 0].tolist(),
        "dropped": track.dropped,
        "first_s": float(track.time_s[0]),
        "last_s": float(track.time_s[-1]),
        "speed_mps": {
            "mean": float(speed.mean()),
            "max": float(speed.max()),
            "epochs_above_design_limit": int((speed > DESIGN_LIMIT_MPS).sum()),
        },
        "height_m": float(track.smooth_x[:, 2].mean()),
        "expected_rmse_m": {
            "horizontal": float(np.sqrt(xx + yy)),
            "vertical": float(np.sqrt(zz)),
        },
        "modes": dict(zip(track.modes, counts.tolist(), strict=True)),
        "switches": int(np.count_nonzero(np.diff(track.mode))),
        **more,
    }
