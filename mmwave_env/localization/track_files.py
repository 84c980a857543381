"""Writers of track files (TUM trajectories, CSV tables, maps), which grow block by block."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mmwave_env.io.files import atomic_path, naming
from mmwave_env.io.lookup import as_cell
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.localization.map_files import MAP_FILES, map_file
from mmwave_env.localization.position_errors import gaussian_levels
from mmwave_env.logs.tum import COLUMNS, tum_lines
from mmwave_env.metrics import RISK
from mmwave_env.models.scene import Scene

TRACK_ENDINGS = (".tum", ".txt")
TABLE_ENDING = ".csv"
ENDINGS = (*TRACK_ENDINGS, TABLE_ENDING, *MAP_FILES)
_VARIANCES = [i * (i + 3) // 2 for i in range(6)]  # indices of variances in packed P
_TRACK_HEADER = f"# {' '.join(COLUMNS)}; mmwave-loc localize\n"
_TABLE_HEADER = (
    "time_s,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m,vx_mps,vy_mps,vz_mps,"
    "sigma_vx_mps,sigma_vy_mps,sigma_vz_mps,mode"
)
_LEVELS_HEADER = ",horizontal_level_m,vertical_level_m"


def table_beside(track: Path) -> Path | None:
    """Return the path of the table of standard deviations beside a TUM file; None for other files.

    Raises:
        ValueError: the ending of the file is not one of :data:`ENDINGS`.
    """
    if track.suffix not in ENDINGS:
        raise ValueError(
            f"out: found {track}, expected a name that ends with one of {', '.join(ENDINGS)}; "
            "the standard deviations of a TUM file are written to a .csv file next to it"
        )
    return track.with_suffix(TABLE_ENDING) if track.suffix in TRACK_ENDINGS else None


def require_own_files(track: Path) -> None:
    """Refuse to replace a file, unless it is an earlier track or an earlier track's table.

    A track and its table can be made again from their log. Any other file, such as a TUM file with
    ground truth, may be the only copy. Users do not type the name of the table, so they may not
    expect it to replace a file.

    Raises:
        ValueError: the track or its table would replace a file that ``localize`` did not write.
        OSError: a file can't be read.
    """
    headers = dict.fromkeys(TRACK_ENDINGS, _TRACK_HEADER) | {TABLE_ENDING: _TABLE_HEADER}
    headers |= {ending: kind.header for ending, kind in MAP_FILES.items()}
    table = table_beside(track)
    for path, problem in (
        (track, "not a track of mmwave-loc localize and would be replaced by the new track"),
        (table, f"not a table of a track and would be replaced by the table of {track}"),
    ):
        if path is None or not path.is_file():
            continue
        header = headers[path.suffix]
        with path.open("rb") as file:
            own = file.read(len(header)) == header.encode()
        if not own:
            raise ValueError(
                f"out: found {path}, which is {problem}, expected another name, such as "
                f"{track.with_stem(f'{track.stem}-track')}"
            )


Write = Callable[[TrackBlock], None]


@contextmanager
def track_files(
    track: Path,
    modes: Sequence[str],
    scene: Scene,
    name: str = "",
    corrected: bool = False,
    risk: float = RISK,
) -> Iterator[Write]:
    """Yield a function that writes the next block of a track; files appear once they are complete.

    Args:
        track: file for the smoothed track; its ending determines the format. Values for which a
            TUM file has no column are written to the file that :func:`table_beside` returns.
        modes: names of the modes.
        scene: the scene; files for maps need its origin.
        name: name of the track in files for maps.
        corrected: whether beliefs are corrected; then the table has a column ``trusted``.
        risk: risk of the protection levels in tables.

    Raises:
        ValueError: the file is for a map, but the scene has no origin.
    """
    if track.suffix in MAP_FILES:
        with map_file(track, scene, name) as write:
            yield write
    elif (table := table_beside(track)) is None:
        with _table_file(track, modes, corrected, risk) as write:
            yield write
    else:
        with (
            _table_file(table, modes, corrected, risk) as write_row,
            _tum_file(track) as write_pose,
        ):

            def write_both(block: TrackBlock) -> None:
                write_pose(block)
                write_row(block)

            yield write_both


@contextmanager
def _tum_file(track: Path) -> Iterator[Write]:
    with atomic_path(track) as path, path.open("w", encoding="utf-8", newline="\n") as tum:
        tum.write(_TRACK_HEADER)

        def write(block: TrackBlock) -> None:
            with naming(track):
                tum.write(tum_lines(block.time_s, block.smooth_x[:, :3]))

        yield write


@contextmanager
def _table_file(path: Path, modes: Sequence[str], corrected: bool, risk: float) -> Iterator[Write]:
    names = [_as_cell(name) for name in modes]
    row = (
        "%r" + ",%.6f" * 3 + ",%.6g" * 3 + ",%.6f" * 3 + ",%.6g" * 3 + ",%s,%.6g,%.6g%s\n"
    ).__mod__
    with atomic_path(path) as beside, beside.open("w", encoding="utf-8", newline="\n") as table:
        table.write(_TABLE_HEADER + _LEVELS_HEADER + ",trusted" * corrected + "\n")

        def write(block: TrackBlock) -> None:
            x = block.smooth_x
            # Because of rounding, a variance may be negative where its exact value is 0.
            sigma = np.sqrt(np.maximum(block.smooth_P[:, _VARIANCES], 0.0))
            numbers = np.column_stack(
                [block.time_s, x[:, :3], sigma[:, :3], x[:, 3:6], sigma[:, 3:]]
            ).tolist()
            levels = gaussian_levels(block.smooth_P, risk) * block.level_factors
            known = np.where(np.isnan(block.smooth_trusted), block.trusted, block.smooth_trusted)
            trusted = [f",{value:.4f}" * corrected for value in known.tolist()]
            cells = zip(numbers, block.mode.tolist(), levels.tolist(), trusted, strict=True)
            rows = [row((*n, names[m], *bounds, last)) for n, m, bounds, last in cells]
            with naming(path):
                table.writelines(rows)

        yield write


def _as_cell(name: str) -> str:
    """Return a name as a CSV cell."""
    cell = io.StringIO()
    csv.writer(cell, lineterminator="").writerow([as_cell(name)])
    return cell.getvalue()
