"""mmwave-loc sweep: many evaluations and training runs, on one machine or a cluster."""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from experiments.console.options import require_at_least


@dataclass
class Args:
    """Run grids of evaluations and training runs on Ray.

    A file says what to combine (docs/sweep.md); each combination is a cell. Cells
    whose results are in the folder --out are not computed again, so the same
    command continues an interrupted sweep. If a cell fails, the failure is
    reported, and the other cells continue.

        mmwave-loc sweep examples/sweep.toml
    """

    spec: Positional[Path]
    """TOML file with one table, [evaluate] or [train]; every
    combination of the values in its lists runs"""
    out: Path | None = None
    """folder of the results, one Parquet file per cell (None: runs/sweep-NAME)"""
    address: str | None = None
    """address of a Ray cluster: auto, or HOST:PORT (None: only this machine)"""
    workers: int | None = None
    """number of cells to compute in parallel on this machine (None: its number of cores)"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.sweeping.run import sweep
    from mmwave_env.io.lookup import as_name, require_extra

    require_at_least(1, args, "workers")
    for package in ("ray", "pyarrow"):
        require_extra(package, "ray", "sweep")
    folder = args.out or Path("runs", f"sweep-{as_name(args.spec.stem)}")
    sweep(args.spec, folder, args.address, args.workers)
