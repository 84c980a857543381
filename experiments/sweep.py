"""mmwave-loc sweep: many evaluations and trainings, on one machine or a cluster."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(kw_only=True)
class Args:
    """Grids of evaluations and trainings, and searches for hyperparameters, on Ray.

    The file says what is to be done (docs/sweep.md). What is there is not computed again: a sweep
    that was ended goes on. Cells that fail are named, and the others go on.

    mmwave-loc sweep examples/sweep.toml
    """

    spec: Positional[Path]
    """TOML or JSON file: one table, [evaluate] or [train], whose lists are combined, or [search]"""
    out: Path | None = None
    """folder of the rows, a Parquet file a cell (runs/sweep-NAME where none is given)"""
    address: str | None = None
    """of a Ray cluster: auto, or HOST:PORT (this machine alone, where none is given)"""
    workers: int | None = None
    """how many cells at once on this machine (as many as it has cores, where none is given)"""


def main(args: Args) -> None:
    """Run the command.

    Raises:
        ValueError: cells failed; the rows of all others are written.
    """
    from experiments.sweeping.run import sweep
    from mmwave_env.io.lookup import as_name, require_extra

    if args.workers is not None and args.workers < 1:
        raise ValueError(f"workers: found {args.workers}, expected 1 or more")
    for package in ("ray", "optuna", "pyarrow"):
        require_extra(package, "ray", "sweep")
    folder = args.out or Path("runs", f"sweep-{as_name(args.spec.stem)}")
    sweep(args.spec, folder, args.address, args.workers)
