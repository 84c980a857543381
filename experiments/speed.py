"""mmwave-loc speed: steps per second, compared with filterpy and with a core's upper limit.

A run of this command does the same work with a loop over filterpy's filters, a single environment
and our vector environment. It also measures the filters alone, the least time that a core needs for
their arithmetic, and the latency of live tracks. Ratios are shown first, since absolute figures
depend much more on the machine.
"""

import os
from dataclasses import dataclass

from experiments.console.options import JsonArgs, require_at_least


@dataclass
class Args(JsonArgs):
    """Measure steps per second of several programs that do the same work.

    mmwave-loc speed --sizes 1 64 1024 --repeats 3
    """

    sizes: tuple[int, ...] = (1, 8, 64, 1024, 16384)
    """sizes of our vector environment (numbers of environments) to measure"""
    seconds: float = 0.5
    """minimum time of each measurement, s; a measurement runs complete episodes"""
    repeats: int = 5
    """number of rounds; each measures everything once, and
    the tables show medians and ranges"""


# No import above may load numpy: its linear algebra reads these variables when it is loaded.
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


def main(args: Args) -> None:
    """Run the command."""
    if not args.sizes or min(args.sizes) < 1:
        raise ValueError(f"sizes: found {list(args.sizes)}, expected numbers of at least 1")
    if not 0.0 <= args.seconds < float("inf"):
        raise ValueError(f"seconds: found {args.seconds}, expected a time of at least 0")
    require_at_least(1, args, "repeats")
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    from mmwave_env.io.files import write_json
    from mmwave_env.io.lookup import require_extra

    require_extra("filterpy", "filterpy", "speed")
    from experiments.console.output import show
    from experiments.console.provenance import provenance
    from experiments.timing.measured import measured, tables_of

    figures = measured(args.sizes, args.seconds, args.repeats)
    tables = tables_of(figures)
    show("\n".join(f"### {title}\n\n{table}\n" for title, table in tables.items()))
    if args.json:
        write_json(args.json, provenance("speed", args) | figures)
