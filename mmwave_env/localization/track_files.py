"""Tracks and truth as files, a block at a time."""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mmwave_env.files import atomic_path
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.localization.tum import COLUMNS, Trajectory, tum_blocks, tum_lines
from mmwave_env.numerics.arrays import Array

TOLERANCE_S = 0.01  # evo's default
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


class Truth:
    """True positions by time, from a TUM file that is read as far as it is needed.

    Args:
        path: of the file.

    Attributes:
        path: of the file.
        first_s: its first time.
        last_s: the last time read so far.

    Raises:
        ValueError, OSError: as :func:`~mmwave_env.localization.tum.tum_blocks`, methods too.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._blocks = tum_blocks(path)
        self._near = [next(self._blocks)]
        self.first_s, self.last_s = (float(self._near[0].time_s[i]) for i in (0, -1))

    def at(self, time_s: Array, tolerance_s: float = TOLERANCE_S) -> Array:
        """Positions (T, 3) nearest to times (T,); NaN where none is within the tolerance.

        Times must increase, also from call to call.
        """
        position, distance = np.full((len(time_s), 3), np.nan), np.full(len(time_s), np.inf)
        for poses in self._until(time_s[-1] + tolerance_s):
            after = np.searchsorted(poses.time_s, time_s)
            for index in (np.maximum(after - 1, 0), np.minimum(after, len(poses.time_s) - 1)):
                away = np.abs(poses.time_s[index] - time_s)
                nearer = (away < distance) & (away <= tolerance_s)
                distance[nearer] = away[nearer]
                position[nearer] = poses.position_m[index[nearer]]
        self._near = [p for p in self._near if p.time_s[-1] >= time_s[-1] - tolerance_s]
        return position

    def _until(self, time_s: float) -> Iterator[Trajectory]:
        """The poses kept, and more, up to a time; of those read, the last two blocks are kept."""
        yield from self._near
        while self.last_s < time_s and (poses := next(self._blocks, None)):
            self.last_s = float(poses.time_s[-1])
            self._near = [*self._near[-1:], poses]
            yield poses

    def read_on(self) -> None:
        """Read to the end, for ``last_s``."""
        for poses in self._blocks:
            self.last_s = float(poses.time_s[-1])
