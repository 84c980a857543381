"""Options of mmwave-loc learned."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Evaluate recorded trainings on test seeds: results, transfer and ablations.

    mmwave-loc learned --episodes 200 --out results/learning
    """

    runs: Path = Path("docs/learning")
    """folder of the recorded runs: ppo-RADIO, ppo-extended-RADIO, guided and guided-ppo (with
    beliefs per mode), ablation/VARIANT and those of studies, studies/TRAINING"""
    episodes: int = 2000
    """simulated episodes of the results; half of them for each study, a quarter for each place and
    variant, a twentieth for each recording; 20 or more"""
    seed: int = 0
    """seed of the first episode; test seeds start at 0"""
    out: Path = Path("results/learning")
    """folder for tables.md and the figures"""
    docs: Path | None = None
    """also renew the tables of this page, between its `<!-- table: ... -->` lines"""
