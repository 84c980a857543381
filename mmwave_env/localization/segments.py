"""Segments of a log: each begins with a line of sight and ends with a long gap.

Prediction bridges seconds. After half a minute without a link the filter is often lost, and
confident of a wrong place. A line of sight gives a correct prior after any gap, so the track ends
and begins anew there. The result does not depend on how a log is cut into blocks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from mmwave_env.logs.log import LogBlock
from mmwave_env.logs.log_columns import RANGE_LIMITS_M
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.prior import GAP_S, STEEPEST_FIX_RAD
from mmwave_env.numerics.numbers import Array, Mask


def segments(blocks: Iterable[LogBlock]) -> Iterator[LogBlock]:
    """Yield the epochs of the segments of a log, each block within one segment.

    A segment ends when neither a link nor odometry was seen for more than ``GAP_S``, or where the
    log says that a track must begin anew. The next segment begins with the next line of sight.

    Raises:
        LogError: from ``blocks``, after the epochs before the damage.
        ValueError: there is no line of sight to begin with.
    """
    held: LogBlock | None = None  # held until its number of dropped epochs is known
    skipped, incomplete = 0, 0
    last_s: float | None = None  # last time with a measurement; None between segments
    try:
        for whole in blocks:
            block = whole
            while len(block):
                begins = last_s is None
                if last_s is None:
                    first = _first_fix(block)
                    if held:
                        held = replace(held, dropped=held.dropped + first)
                    else:
                        skipped += first
                        incomplete += int(block.incomplete[:first, 0].sum())
                    block = block.part(slice(first, None))
                    if not len(block):
                        break
                    last_s = float(block.time_s[0])
                end, last_s = _end(block, last_s, begins)
                if end:
                    if held:
                        yield held
                    held = replace(
                        block.part(slice(end)),
                        segment=held.segment + begins if held else 0,
                        begins=begins,
                        skipped=skipped,
                        dropped=held.dropped if held else 0,
                    )
                block = block.part(slice(end, None))
    except LogError:
        if held:
            yield held
        raise
    if not held:
        raise ValueError(
            f"log: found {skipped} epochs without a line of sight, expected one with a range of "
            f"at least {RANGE_LIMITS_M[0]:g} m, angles and SNR of anchor 1, and an elevation of at "
            f"most {np.degrees(STEEPEST_FIX_RAD):g} degrees, where the track begins "
            f"({incomplete} have only some of these)"
        )
    yield held


def gives_fix(links: Array) -> Mask:
    """Tell which links (n, 4 or more), m and rad, give a prior.

    Straight above or below an anchor the azimuth is undefined. Near there the uncertainty of the
    direction grows with the elevation, which a Gaussian does not describe.
    """
    return (links[:, 0] >= RANGE_LIMITS_M[0]) & (abs(links[:, 2]) <= STEEPEST_FIX_RAD)


def _first_fix(block: LogBlock) -> int:
    """Return the index of the first epoch that gives a prior; without one, the number of epochs."""
    fixes = np.flatnonzero(block.visible[:, 0] & gives_fix(block.measurement))
    return int(fixes[0]) if len(fixes) else len(block)


def _end(block: LogBlock, last_s: float, begins: bool) -> tuple[int, float | None]:
    """Count the block's epochs in the segment; return also the time of its last measurement.

    The time is None if the segment ends in this block; ``begins`` tells whether it starts here.
    """
    measured = block.visible[:, : block.layout.anchors].any(axis=1)
    if block.layout.odometry:  # dead reckoning bridges two minutes as well as ten seconds
        measured |= block.visible[:, -1]
    latest = np.maximum.accumulate(np.where(measured, block.time_s, last_s))
    before = np.concatenate([[last_s], latest[:-1]])
    ends = (block.time_s - before > GAP_S) | block.restarts
    ends[0] &= not begins
    over = np.flatnonzero(ends)
    return (int(over[0]), None) if len(over) else (len(block), float(latest[-1]))
