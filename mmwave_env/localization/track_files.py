"""Tracks as files, a block at a time."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mmwave_env.files import atomic_path
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.logs.tum import COLUMNS, tum_lines

_VARIANCES = [i * (i + 3) // 2 for i in range(6)]  # of positions and velocities in a packed P
TABLE_COLUMNS = (
    "time_s", "x_m", "y_m", "z_m", "sigma_x_m", "sigma_y_m", "sigma_z_m", "vx_mps", "vy_mps",
    "vz_mps", "sigma_vx_mps", "sigma_vy_mps", "sigma_vz_mps", "mode",
)  # fmt: skip


def table_beside(track: Path) -> Path:
    """Where the standard deviations of a TUM file go.

    Raises:
        ValueError: the file has that name itself.
    """
    table = track.with_suffix(".csv")
    if table == track:
        raise ValueError(
            f"out: found {track}, expected a TUM file such as {track.with_suffix('.tum')}, because "
            "its standard deviations go to a .csv beside it"
        )
    return table


def require_own_table(track: Path) -> None:
    """Make sure that the table beside a TUM file replaces nothing but such a table.

    Its name was never typed, so whatever else has it is not meant to go.

    Raises:
        ValueError: a file of another header has that name.
        OSError: it can't be read.
    """
    table = table_beside(track)
    if not table.is_file():
        return
    header = (",".join(TABLE_COLUMNS) + "\n").encode()
    with table.open("rb") as file:
        if file.read(len(header)) != header:
            raise ValueError(
                f"out: found {table}, which is no table of a track and which that of {track} would "
                f"replace, expected another name, such as {track.with_stem(f'{track.stem}-track')}"
            )


@contextmanager
def track_files(track: Path, modes: Sequence[str]) -> Iterator[Callable[[TrackBlock], None]]:
    """A function that writes the next block of a track; at the end the files take their places.

    Args:
        track: TUM file for the smoothed track; :func:`table_beside` it, everything else.
        modes: their names.
    """
    names = [_as_cell(name) for name in modes]
    row = ("%r" + ",%.6f" * 3 + ",%.6g" * 3 + ",%.6f" * 3 + ",%.6g" * 3 + ",%s\n").__mod__
    with (
        atomic_path(track) as track_path,
        atomic_path(table_beside(track)) as table_path,
        track_path.open("w", encoding="utf-8", newline="\n") as tum,
        table_path.open("w", encoding="utf-8", newline="\n") as table,
    ):
        tum.write(f"# {' '.join(COLUMNS)}; mmwave-loc localize\n")
        table.write(",".join(TABLE_COLUMNS) + "\n")

        def write(block: TrackBlock) -> None:
            x = block.smooth_x
            tum.write(tum_lines(block.time_s, x[:, :3]))
            # Not below 0: rounding may take a variance there that is known to be 0.
            sigma = np.sqrt(np.maximum(block.smooth_P[:, _VARIANCES], 0.0))
            numbers = np.column_stack(
                [block.time_s, x[:, :3], sigma[:, :3], x[:, 3:6], sigma[:, 3:]]
            ).tolist()
            modes_run = block.mode.tolist()
            table.writelines([row((*n, names[m])) for n, m in zip(numbers, modes_run, strict=True)])

        yield write


def _as_cell(name: str) -> str:
    """A name as a CSV cell."""
    cell = io.StringIO()
    csv.writer(cell, lineterminator="").writerow([name])
    return cell.getvalue()
