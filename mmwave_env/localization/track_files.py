"""Track files, written block by block."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mmwave_env.io.files import atomic_path, naming
from mmwave_env.io.lookup import as_cell
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.logs.tum import COLUMNS, tum_lines

TRACK_ENDINGS = (".tum", ".txt")
_VARIANCES = [i * (i + 3) // 2 for i in range(6)]  # of positions and velocities in packed P
_TRACK_HEADER = f"# {' '.join(COLUMNS)}; mmwave-loc localize\n"
_TABLE_HEADER = (
    "time_s,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m,vx_mps,vy_mps,vz_mps,"
    "sigma_vx_mps,sigma_vy_mps,sigma_vz_mps,mode\n"
)


def table_beside(track: Path) -> Path:
    """Return the path of the table of standard deviations that belongs to a TUM file.

    Raises:
        ValueError: the name of the file is that of another format.
    """
    if track.suffix not in TRACK_ENDINGS:
        raise ValueError(
            f"out: found {track}, expected a TUM file: a name that ends with "
            f"{' or '.join(TRACK_ENDINGS)}; its standard deviations go to a .csv beside it"
        )
    return track.with_suffix(".csv")


def require_own_files(track: Path) -> None:
    """Refuse to replace any file other than a track and the table beside it.

    A track and its table can be made again from their log. Any other file may be the only copy:
    a recorded truth is a TUM file, too, and the user never typed the name of the table.

    Raises:
        ValueError: a file with another header has one of the names.
        OSError: a file can't be read.
    """
    table = table_beside(track)
    for path, header, problem in (
        (track, _TRACK_HEADER, "no track of mmwave-loc localize and which the new one"),
        (table, _TABLE_HEADER, f"no table of a track and which that of {track}"),
    ):
        if not path.is_file():
            continue
        with path.open("rb") as file:
            own = file.read(len(header)) == header.encode()
        if not own:
            raise ValueError(
                f"out: found {path}, which is {problem} would replace, expected another name, such "
                f"as {track.with_stem(f'{track.stem}-track')}"
            )


@contextmanager
def track_files(track: Path, modes: Sequence[str]) -> Iterator[Callable[[TrackBlock], None]]:
    """Yield a function that writes the next block of a track; at the end, put the files in place.

    Args:
        track: TUM file for the smoothed track; :func:`table_beside` it has the other columns.
        modes: names of the modes.
    """
    names = [_as_cell(name) for name in modes]
    row = ("%r" + ",%.6f" * 3 + ",%.6g" * 3 + ",%.6f" * 3 + ",%.6g" * 3 + ",%s\n").__mod__
    with (
        atomic_path(track) as track_path,
        atomic_path(table_beside(track)) as table_path,
        track_path.open("w", encoding="utf-8", newline="\n") as tum,
        table_path.open("w", encoding="utf-8", newline="\n") as table,
    ):
        tum.write(_TRACK_HEADER)
        table.write(_TABLE_HEADER)

        def write(block: TrackBlock) -> None:
            x = block.smooth_x
            with naming(track):
                tum.write(tum_lines(block.time_s, x[:, :3]))
            # Rounding may take a variance that is known to be 0 below 0.
            sigma = np.sqrt(np.maximum(block.smooth_P[:, _VARIANCES], 0.0))
            numbers = np.column_stack(
                [block.time_s, x[:, :3], sigma[:, :3], x[:, 3:6], sigma[:, 3:]]
            ).tolist()
            modes_run = block.mode.tolist()
            rows = [row((*n, names[m])) for n, m in zip(numbers, modes_run, strict=True)]
            with naming(table_beside(track)):
                table.writelines(rows)

        yield write
        with naming(track):
            tum.flush()


def _as_cell(name: str) -> str:
    """Return a name as a CSV cell."""
    cell = io.StringIO()
    csv.writer(cell, lineterminator="").writerow([as_cell(name)])
    return cell.getvalue()
