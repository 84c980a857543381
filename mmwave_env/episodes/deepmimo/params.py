"""``params.json`` of a DeepMIMO v4 scenario: what is read of it, and what is refused."""

import json
from pathlib import Path
from typing import Any

from mmwave_env.episodes.tables import refuse

PARAMS = "params.json"  # by which a folder is known as a scenario
_HIGHEST_HZ = 1e15
_MOST_BYTES = 2**24


class Params:
    """The parameters of a scenario.

    Args:
        folder: of the scenario.

    Attributes:
        file: ``params.json``.

    Raises:
        FileNotFoundError: the folder has no such file.
        ValueError: it is no JSON. Every property raises it where an entry is missing, or is not
            what it should be; the message names it.
    """

    def __init__(self, folder: Path) -> None:
        self.file = folder / PARAMS
        if not self.file.exists():
            raise FileNotFoundError(
                f"{self.file}: found no such file, expected the parameters of a scenario"
            )
        if not self.file.is_file() or self.file.stat().st_size > _MOST_BYTES:
            refuse(self.file, "file", "no regular file, or a long one",
                   f"JSON of at most {_MOST_BYTES} bytes")  # fmt: skip
        try:
            self._tree = json.loads(self.file.read_text(encoding="utf-8"))
        except (ValueError, OSError, RecursionError) as error:
            raise ValueError(
                f"{self.file}: found no readable JSON ({error}), expected JSON"
            ) from error

    @property
    def carrier_hz(self) -> float:
        """Carrier frequency."""
        frequency = self._entry("rt_params", "frequency")
        if not _is_number(frequency) or not 0.0 < frequency < _HIGHEST_HZ:
            refuse(self.file, "rt_params.frequency", repr(frequency), "a positive number of hertz")
        return float(frequency)

    @property
    def scenes(self) -> int:
        """How many scenes there are; more than one makes the scenario a dynamic one."""
        return self._count("scene", "num_scenes")

    def require_receivers(self, number: int, count: int) -> None:
        """Refuse a set of receivers, by its number, that has another count of them here."""
        sets = self._entry("txrx_sets")
        for name in sets if isinstance(sets, dict) else ():
            if self._entry("txrx_sets", name, "id") == number:
                points = self._count("txrx_sets", name, "num_points")
                if points != count:
                    refuse(self.file, f"txrx_sets.{name}.num_points", points,
                           f"{count}, the number of receivers in rx_pos")  # fmt: skip
                return
        refuse(self.file, "txrx_sets", "no such set", f"the set of receivers with id {number}")

    def _count(self, *keys: str) -> int:
        value = self._entry(*keys)
        if not _is_number(value) or value != value // 1 or value < 1:
            refuse(self.file, ".".join(keys), repr(value), "a whole number, at least 1")
        return int(value)

    def _entry(self, *keys: str) -> Any:
        """What stands under nested keys."""
        tree = self._tree
        for depth, key in enumerate(keys):
            if not isinstance(tree, dict) or key not in tree:
                refuse(self.file, ".".join(keys[: depth + 1]), "nothing", "an entry")
            tree = tree[key]
        return tree


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
