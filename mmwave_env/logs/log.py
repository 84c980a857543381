"""Measurement logs: one row per epoch and anchor, as a receiver writes them.

The name of a column (`log_columns.py`) is a quantity and a unit: ``time_s, anchor, toa_s,
aoa_azimuth_rad, aoa_elevation_rad, aod_azimuth_rad, doppler_hz, snr_db``, and optionally
``doppler_spread_hz`` and odometry, ``speed_mps`` and ``heading_rad``. An anchor is its number
in the scene, from 1, the physical gNB, whose rows alone have a Doppler shift. A cell that was
not measured is empty; an anchor that was not seen may be left out. Quantities of the epoch, not
of an anchor (Doppler spread, odometry), may be in any row of the epoch.

A log may be larger than memory, so it is read in blocks of consecutive epochs.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from mmwave_env.logs.log_checks import EpochRows, whole_epochs
from mmwave_env.logs.log_columns import LINK_QUANTITIES
from mmwave_env.logs.log_tables import LogError, open_log
from mmwave_env.models.measurement import Layout, seen_from_image, whole_groups, wrap_angles
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array, Mask

AnyBlock = TypeVar("AnyBlock", bound="Block")


class Block:
    """T consecutive epochs, as a dataclass of arrays (T, ...) and of values that they share."""

    per_epoch: ClassVar[tuple[str, ...]]  # names of the arrays; joined blocks share the last's rest
    time_s: Any

    def __init_subclass__(cls) -> None:
        hints = cls.__annotations__.items()
        cls.per_epoch = tuple(
            name for name, hint in hints if getattr(hint, "__origin__", 0) is np.ndarray
        )

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self: AnyBlock, epochs: slice) -> AnyBlock:
        """Return a part of the epochs."""
        return self._with({name: getattr(self, name)[epochs] for name in self.per_epoch})

    @classmethod
    def joined(cls, blocks: Sequence[AnyBlock]) -> AnyBlock:
        """Join blocks that follow each other."""
        return blocks[-1]._with(
            {name: np.concatenate([getattr(b, name) for b in blocks]) for name in cls.per_epoch}
        )

    def _with(self: AnyBlock, arrays: dict[str, Any]) -> AnyBlock:
        return replace(self, **arrays)  # type: ignore[type-var]


def in_windows(
    blocks: Iterable[AnyBlock], window: int, piece: Callable[[AnyBlock], int] = lambda block: 0
) -> Iterator[AnyBlock]:
    """Yield the same epochs in blocks of whole windows, and the rest at the end of each piece.

    Epochs before a LogError of ``blocks`` are delivered before it. ``piece`` returns the number of
    the piece that a block belongs to; pieces are not joined.
    """
    waiting: list[AnyBlock] = []

    def rest() -> Iterator[AnyBlock]:
        if waiting:
            yield waiting[-1].joined(waiting)

    try:
        for block in blocks:
            if waiting and piece(block) != piece(waiting[0]):
                yield from rest()
                waiting = []
            waiting.append(block)
            if sum(map(len, waiting)) >= window:
                joined = block.joined(waiting)
                whole = len(joined) // window * window
                yield joined.part(slice(whole))
                waiting = [joined.part(slice(whole, None))] if whole < len(joined) else []
    except LogError:
        yield from rest()
        raise
    yield from rest()


@dataclass(frozen=True, eq=False)
class LogBlock(Block):
    """T consecutive epochs of a log; numbers of groups that are not visible have no meaning.

    Attributes:
        layout: rows and groups of the measurements.
        time_s: (T,) increasing, also across blocks.
        measurement: (T, rows) m, rad, Hz, m/s; angles in [-pi, pi).
        visible: (T, groups) whether every number of the group was measured; for a link and for
            the Doppler shift that includes the SNR, because their noise follows from it.
        incomplete: (T, groups) whether only some of the numbers were measured: a lost group.
        snr_db: (T, L); -inf, no signal, where none was measured.
        doppler_spread_hz: (T,); 0 where none was measured.
        restarts: (T,) whether a track must begin anew here, because its association with
            anchors contradicts the epochs before. It is never set in a log with anchor numbers.
        rows: number of rows of the file read, up to the end of this block or somewhat further.
        share: share of the file read so far, 0 to 1.
    """

    layout: Layout
    time_s: Array
    measurement: Array
    visible: Mask
    incomplete: Mask
    snr_db: Array
    doppler_spread_hz: Array
    restarts: Mask
    rows: int
    share: float


def read_log(
    path: Path,
    scene: Scene,
    epochs_per_block: int = 4096,
    odometry: bool = True,
    limits: bool = True,
) -> Iterator[LogBlock]:
    """Read the epochs of a log, ``epochs_per_block`` at a time; the last block may be shorter.

    Angles are in the frame of the map. Arrival is the direction from the anchor to the
    user; departure is the azimuth from the user to the anchor. docs/data.md has a figure.

    Where the log is damaged, every whole epoch before the damage is delivered first. An epoch
    whose end is unknown because of the damage (no later time can be read, and not all anchors are
    present) does not count as whole.

    Args:
        path: CSV (``.csv``, ``.csv.gz``) or Parquet (``.parquet``, needs the extra `data`).
        scene: scene whose anchors were measured.
        epochs_per_block: number of epochs in a block.
        odometry: False to ignore columns of odometry. Otherwise ``layout`` has odometry
            where the log has it.
        limits: False to accept ranges and angles of any size, and not to wrap angles, for
            a diagnosis.

    Raises:
        LogError: at once for a file or a header that is not a log's, later for a damaged row,
            naming file, row, column, what was found and what was expected; at the end for a
            log without rows or without a single measurement.
        OSError: the file can't be read.
    """
    if epochs_per_block < 1:
        raise ValueError(f"epochs_per_block: found {epochs_per_block}, expected at least 1")
    log = open_log(path, scene.hz_per_mps, odometry)
    layout = Layout(len(scene.anchors_m), "speed" in log.columns)
    rows = whole_epochs(log, layout.anchors, limits)
    blocks = (_block(epochs, scene, layout, limits) for epochs in rows)
    return _regroup(_require_measurements(log.path, blocks), epochs_per_block)


def _require_measurements(path: Path, blocks: Iterable[LogBlock]) -> Iterator[LogBlock]:
    """Yield the blocks; raise an error after the last one if none had a measurement."""
    rows, incomplete, measured = 0, 0, False
    for block in blocks:
        rows, incomplete = block.rows, incomplete + int(block.incomplete.sum())
        measured = measured or bool(block.visible.any())
        yield block
    if not measured:
        found = f"{rows} rows without a measurement" if rows else "a header and no rows"
        lost = f", and {incomplete} groups with only some of their numbers" if incomplete else ""
        raise LogError(f"{path}: found {found}{lost}, expected at least one measurement")


def _regroup(blocks: Iterable[LogBlock], epochs: int) -> Iterator[LogBlock]:
    """Yield blocks of ``epochs`` epochs, and then the rest."""
    for whole in in_windows(blocks, epochs):
        for first in range(0, len(whole), epochs):
            yield whole.part(slice(first, first + epochs))


def _block(rows: EpochRows, scene: Scene, layout: Layout, wrap: bool) -> LogBlock:
    """Return rows of whole epochs as a block."""
    cells, epoch, T, L = rows.cells, rows.epoch, rows.epochs, layout.anchors
    anchor = cells["anchor"].astype(np.int64) - 1
    if "aoa_azimuth_station" in cells:
        arrival = cells["aoa_azimuth_station"], cells["aoa_elevation"]
        seen = [seen_from_image(*arrival, scene.anchors_m[0], image) for image in scene.anchors_m]
        cells["aoa_azimuth"], cells["aoa_elevation"] = np.array(seen)[
            anchor, :, range(len(epoch))
        ].T
    time, snr, measurement = np.empty(T), np.full((T, L), np.nan), np.full((T, layout.size), np.nan)
    time[epoch] = cells["time"]
    snr[epoch, anchor] = cells["snr"]
    for i, quantity in enumerate(LINK_QUANTITIES):
        measurement[epoch, 4 * anchor + i] = cells[quantity]
    measurement[:, layout.doppler] = rows.once("doppler")
    if layout.odometry:
        measurement[:, layout.doppler + 1] = rows.once("speed")
        measurement[:, layout.doppler + 2] = rows.once("heading")
    if wrap:
        wrap_angles(measurement, layout)
    visible, incomplete = whole_groups(measurement, np.isfinite(snr), layout)
    return LogBlock(
        layout=layout,
        time_s=time,
        measurement=measurement,
        visible=visible,
        incomplete=incomplete,
        snr_db=np.where(np.isnan(snr), -np.inf, snr),
        doppler_spread_hz=np.nan_to_num(rows.once("doppler_spread")),
        restarts=np.zeros(T, bool),
        rows=rows.rows,
        share=rows.share,
    )
