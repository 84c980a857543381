"""What a cell costs beside its work: ``python -m tests.sweeping.overhead --engine ray``.

Cells do nothing and are kept as any others: the figures of docs/scale.md.
"""

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

from experiments.sweeping.cell import Cell
from experiments.sweeping.engines import local, on_ray
from experiments.sweeping.results import ResultSet
from experiments.sweeping.spec import Spec
from mmwave_env.metrics import METRICS


def nothing(cell):
    """What a cell of one episode leaves, without playing it."""
    (_, number) = cell.values[0]
    return {"scores": {m: [0.0] for m in METRICS}, "episode_seed": [number], "episode_key": [None]}


def main():
    """Print the figures of a run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--engine", choices=("local", "ray"), default="local")
    parser.add_argument("--cells", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    args = parser.parse_args()
    spec = Spec("nothing", tuple(Cell("evaluate", (("seed", n),)) for n in range(args.cells)))
    with tempfile.TemporaryDirectory() as folder:
        results, begin = ResultSet(Path(folder), spec), time.perf_counter()
        engine = {"local": local, "ray": on_ray}[args.engine]
        with results.locked():
            for count, done in enumerate(engine(nothing, spec.cells, args.workers, 1)):
                if not count:
                    first_s = time.perf_counter() - begin
                results.add(done.cell, done.result)
        whole_s = time.perf_counter() - begin
        there = len(results.finished())
        files = list(results.folder.glob("*.parquet"))
        size = sum(path.stat().st_size for path in files)
    each_ms = 1e3 * (whole_s - first_s) / (args.cells - 1)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{args.engine}, {args.workers} workers: {there} cells kept, the first after "
          f"{first_s:.1f} s, each {each_ms:.2f} ms; {len(files)} files, "
          f"{size / there:.0f} bytes a cell; peak memory {peak:.0f} MiB")  # fmt: skip


if __name__ == "__main__":
    main()
