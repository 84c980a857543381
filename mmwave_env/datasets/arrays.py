"""What a user has, arrays by name, becomes what episodes are made of: rows, masks, velocities."""

import warnings
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from mmwave_env.models.measurement import LINK, Layout, exact_rows, wrap_angles
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.arrays import Array, Mask
from mmwave_env.numerics.numbers import wrap
from mmwave_env.world.checks import refuse, require_increasing

# m, rad: medians beyond _FAR are wrong however noisy, those within _NEAR hardly matter.
_FAR, _NEAR = (50.0, 0.5, 0.5, 0.5), (5.0, 0.05, 0.05, 0.05)
_NOISE = 0.6745 * np.sqrt(2.0)  # median size of a difference of two errors of unit deviation
_ENOUGH = 20  # epochs for a median


def numbers(record: str, field: str, values: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """An array of numbers, a copy, of a shape; None is any length but 0."""
    try:
        array = np.array(values, float)
    except (TypeError, ValueError) as error:
        refuse(record, field, f"{type(values).__name__} ({error})", "an array of numbers")
    fits = array.ndim == len(shape) and all(
        n == wanted if wanted is not None else n > 0
        for n, wanted in zip(array.shape, shape, strict=True)
    )
    if not fits:
        refuse(record, field, f"shape {array.shape}", f"shape {shape}".replace("None", "any"))
    return array


def truth_of(
    record: str, time_s: ArrayLike, position_m: ArrayLike, velocity_mps: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Times (T,), which increase, positions and velocities (T, 3); by differences if not given."""
    time = numbers(record, "time_s", time_s, (None,))
    require_increasing(record, time)
    position = numbers(record, "position_m", position_m, (len(time), 3))
    if velocity_mps is None:
        return time, position, velocity_of(time, position)
    return time, position, numbers(record, "velocity_mps", velocity_mps, (len(time), 3))


def link_rows(
    record: str, layout: Layout, links: Sequence[ArrayLike], doppler_hz: ArrayLike, epochs: int
) -> Array:
    """Measurements (T, rows), angles in [-pi, pi), from arrays (T, L) in the order of ``LINK``."""
    rows = np.empty((epochs, layout.size))
    for i, (name, values) in enumerate(zip(LINK, links, strict=True)):
        shape = (epochs, layout.anchors)
        rows[:, i : layout.doppler : 4] = numbers(record, name, values, shape)
    rows[:, layout.doppler] = numbers(record, "doppler_hz", doppler_hz, (epochs,))
    wrap_angles(rows, layout)
    return rows


def stretches(time_s: Array, position_m: Array) -> list[slice]:
    """Runs of two epochs or more that all have a position, without a gap of more than GAP_S.

    Args:
        time_s: (T,) increasing.
        position_m: (T, 3), NaN where not known.
    """
    known: Mask = np.logical_and.reduce(np.isfinite(position_m), axis=1)
    ends = np.flatnonzero(~known[:-1] | ~known[1:] | (np.diff(time_s) > GAP_S)) + 1
    runs = [slice(a, b) for a, b in pairwise([0, *ends.tolist(), len(time_s)])]
    return [run for run in runs if run.stop - run.start > 1]


def velocity_of(time_s: Array, position_m: Array) -> Array:
    """Velocities (T, 3) by differences of positions, within stretches; NaN outside of them."""
    velocity = np.full_like(position_m, np.nan)
    for run in stretches(time_s, position_m):
        velocity[run] = np.gradient(position_m[run], time_s[run], axis=0)
    return velocity


def warn_of_contradictions(
    record: str, scene: Scene, layout: Layout, measurement: Array, visible: Mask, position_m: Array
) -> None:
    """Warn where links are, in the median, far from what the true positions make them.

    That is a convention or a unit mistaken, or a truth in another frame; not noise, which is
    judged by how much errors differ from one epoch to the next.

    Args:
        record: for the message.
        scene: whose anchors were measured.
        layout: of the rows.
        measurement, visible: (T, rows), (T, groups).
        position_m: (T, 3), NaN where not known.
    """
    where = list(position_m.T)
    exact = exact_rows(where, [0.0] * 3, scene.anchors_m.tolist(), 0.0, Layout(layout.anchors))
    far = []
    for a in range(layout.anchors):
        seen = visible[:, a] & np.isfinite(position_m).all(axis=1)
        if seen.sum() < _ENOUGH:
            continue
        for i, name in enumerate(LINK):
            error = (measurement[:, 4 * a + i] - exact[4 * a + i])[seen]
            step = np.diff(error)
            median, differ = (float(np.median(np.abs(wrap(e) if i else e))) for e in (error, step))
            # Noise alone makes the median two thirds of its deviation.
            if median > min(_FAR[i], max(_NEAR[i], 2.0 * differ / _NOISE)):
                far.append(f"{name} of anchor {a + 1} by {median:.3g}")
    if far:
        warnings.warn(
            f"{record}: found a median far from the truth, {', '.join(far)}; expected units, "
            'angles and frame as in docs/data.md ("Angles")',
            stacklevel=2,
        )
