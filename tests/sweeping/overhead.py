"""What a cell costs beside its work: ``python -m tests.sweeping.overhead --engine ray``.

Cells do nothing and are kept as any others: the figures of docs/scale.md.
"""

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.sweeping.cell import Cell
from experiments.sweeping.engines import local, on_ray
from experiments.sweeping.results import ResultSet
from experiments.sweeping.spec import Spec
from mmwave_env.metrics import METRICS


def nothing(cell):
    """What a cell leaves, without playing its episodes."""
    values = dict(cell.values)
    scores = np.random.default_rng(values["seed"]).normal(size=(len(METRICS), values["episodes"]))
    seeds = range(values["seed"], values["seed"] + values["episodes"])
    return {
        "scores": dict(zip(METRICS, scores, strict=True)),
        "episode_seed": list(seeds), "episode_key": list(seeds),
    }  # fmt: skip


def main():
    """Print the figures of a run."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--engine", choices=("local", "ray"), default="local")
    parser.add_argument("--cells", type=int, default=10_000)
    parser.add_argument("--episodes", type=int, default=1, help="of a cell")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    args = parser.parse_args()
    firsts = range(0, args.cells * args.episodes, args.episodes)
    values = ((("episodes", args.episodes), ("seed", first)) for first in firsts)
    spec = Spec("nothing", tuple(Cell("evaluate", pairs) for pairs in values))
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
