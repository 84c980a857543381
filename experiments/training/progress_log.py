"""The course of a training: rows of a CSV file, and events for TensorBoard."""

import csv
import io
from contextlib import suppress
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter
from torch.utils.tensorboard import SummaryWriter

from mmwave_env.files import write_text

STEP = "timesteps"


class ProgressLog(KVWriter):
    """What is logged: a row has what was collected lately, and the update after it.

    Args:
        folder: for ``progress.csv`` and TensorBoard's events.
        rows: of a training that goes on here; what came after them is forgotten.
    """

    def __init__(self, folder: Path, rows: list[dict[str, float]]) -> None:
        self.rows = list(rows)
        self._path = folder / "progress.csv"
        after = {"purge_step": int(rows[-1][STEP]) + 1} if rows else {}
        self._events = SummaryWriter(str(folder), **after)

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Take a row; times are left out that Stable-Baselines3 counts from the latest start."""
        numbers = {
            key: float(value) for key, value in key_values.items() if not key.startswith("time/")
        }
        for key, value in numbers.items():
            self._events.add_scalar(key, value, step)
        self.rows.append({STEP: float(step), **numbers})

    def save(self) -> None:
        """Write the CSV file: empty cells where there is no figure."""
        names = dict.fromkeys(name for row in self.rows for name in row)
        text = io.StringIO()
        table = csv.DictWriter(text, list(names), lineterminator="\n")
        table.writeheader()
        table.writerows(
            {name: f"{value:.6g}" if name != STEP else int(value) for name, value in row.items()}
            for row in self.rows
        )
        write_text(self._path, text.getvalue())

    def __enter__(self) -> "ProgressLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write all that is left; where the training failed, end the thread that writes events."""
        if kind is None:
            self.save()
            self._events.close()
        else:
            with suppress(OSError):  # such as the full disk that it failed of
                self._events.close()
