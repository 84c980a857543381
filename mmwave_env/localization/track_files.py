"""Files of tracks: TUM trajectories, CSV tables, maps."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mmwave_env.io.files import write_text
from mmwave_env.io.lookup import as_cell
from mmwave_env.localization.localizer import Track
from mmwave_env.localization.map_files import MAP_FILES, origin_of
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
_ROW = "%r" + ",%.6f" * 3 + ",%.6g" * 3 + ",%.6f" * 3 + ",%.6g" * 3 + ",%s,%.6g,%.6g%s\n"


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


def write_track(
    track: Track, files: Sequence[Path], scene: Scene, name: str = "", risk: float = RISK
) -> None:
    """Write a track to files; the contents of all files are complete before the first is written.

    Args:
        track: the track, of which the smoothed beliefs are written.
        files: files, whose endings determine the formats. Values for which a TUM file has no
            column are written to the file that :func:`table_beside` returns.
        scene: the scene; files for maps need its origin.
        name: name of the track in files for maps.
        risk: risk of the protection levels in tables.

    Raises:
        ValueError: a file is for a map, but the scene has no origin.
        OSError: a file can't be written.
    """
    texts: dict[Path, str] = {}
    for path in files:
        table = table_beside(path)
        if path.suffix in MAP_FILES:
            texts[path] = MAP_FILES[path.suffix].text(track, origin_of(scene, f"out: {path}"), name)
            continue
        texts[table or path] = table_text(track, risk)
        if table:
            texts[path] = _TRACK_HEADER + tum_lines(track.time_s, track.smooth_x[:, :3])
    for path, text in texts.items():
        write_text(path, text)


def table_text(track: Track, risk: float) -> str:
    """Return a track as a table, CSV; with a column ``trusted`` if its beliefs were corrected."""
    names = [_as_cell(name) for name in track.modes]
    corrected = bool(np.isfinite(track.trusted).any())
    x = track.smooth_x
    # Because of rounding, a variance may be negative where its exact value is 0.
    sigma = np.sqrt(np.maximum(track.smooth_P[:, _VARIANCES], 0.0))
    numbers = np.column_stack([track.time_s, x[:, :3], sigma[:, :3], x[:, 3:6], sigma[:, 3:]])
    levels = gaussian_levels(track.smooth_P, risk) * track.level_factors
    known = np.where(np.isnan(track.smooth_trusted), track.trusted, track.smooth_trusted)
    trusted = [f",{value:.4f}" if corrected else "" for value in known.tolist()]
    cells = zip(numbers.tolist(), track.mode.tolist(), levels.tolist(), trusted, strict=True)
    rows = [_ROW % (*row, names[mode], *bounds, last) for row, mode, bounds, last in cells]
    more = ",trusted" if corrected else ""
    return f"{_TABLE_HEADER}{_LEVELS_HEADER}{more}\n{''.join(rows)}"


def _as_cell(name: str) -> str:
    """Return a name as a CSV cell."""
    cell = io.StringIO()
    csv.writer(cell, lineterminator="").writerow([as_cell(name)])
    return cell.getvalue()
