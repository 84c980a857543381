"""Watchers that collect every epoch of a comparison for pictures and percentiles."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.console.options import EpisodeArgs
from experiments.evaluation import positions
from experiments.evaluation.histories import EpochErrors
from experiments.evaluation.positions import Positions, positions_markdown
from experiments.evaluation.runner import Watch
from experiments.figures.canvas import require_picture
from experiments.figures.curves import draw_consistency, draw_error_cdf
from mmwave_env.localization.position_errors import require_risk

Made = tuple[str, dict[str, Any]]  # Markdown below the tables, and figures for JSON


class Watcher(NamedTuple):
    """A collector of the epochs of all contenders.

    Attributes:
        add: takes the epoch results of a contender.
        told: returns Markdown below the tables, and figures.
        draw: writes the pictures.
        parts: entries of the engine's state that ``add`` needs after every epoch.
    """

    add: Watch
    told: Callable[[], Made] = lambda: ("", {})
    draw: Callable[[], None] = lambda: None
    parts: Sequence[str] = ()


def require_options(args: EpisodeArgs, pictures: Mapping[str, Path]) -> None:
    """Refuse an impossible risk or file, before any work.

    Args:
        args: options that the commands share.
        pictures: files by option.

    Raises:
        ValueError: names the option; also raised where two pictures have the same file.
        OSError: a file can't be written.
    """
    require_risk(args.risk)
    seen: dict[Path, str] = {}
    for option, path in pictures.items():
        require_picture(option, path)
        if seen.setdefault(path, option) != option:
            raise ValueError(f"{option}: found {path}, expected another file than --{seen[path]}")


def watchers(
    args: EpisodeArgs, names: Mapping[str, str], pictures: Mapping[str, Path]
) -> list[Watcher]:
    """Return the watchers that options ask for.

    Args:
        args: options that the commands share.
        names: name in figures, by contender.
        pictures: files of "errors" and "consistency", where asked for.
    """
    found = []
    if "errors" in pictures or "consistency" in pictures:
        found.append(_errors(args, names, pictures))
    if args.percentiles:
        found.append(_positions(args, names))
    return found


def _errors(args: EpisodeArgs, names: Mapping[str, str], pictures: Mapping[str, Path]) -> Watcher:
    epochs = EpochErrors(names)

    def draw() -> None:
        if "errors" in pictures:
            draw_error_cdf(epochs.errors_m, pictures["errors"])
        if "consistency" in pictures:
            dof = 2 if args.planar else 3
            draw_consistency(epochs.time_s, epochs.nees, dof, pictures["consistency"])

    return Watcher(epochs.add, draw=draw)


def _positions(args: EpisodeArgs, names: Mapping[str, str]) -> Watcher:
    seen = Positions(names, args.risk, args.planar)

    def told() -> Made:
        figures = seen.figures()
        text = positions_markdown("policy", figures["policies"], args.risk)
        return f"\n{text}", {"position_errors": figures}

    return Watcher(seen.add, told, parts=positions.PARTS)
