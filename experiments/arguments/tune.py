"""Options of mmwave-loc tune."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from experiments.arguments.shared import JsonArgs
from experiments.evaluation.seeds import TUNING_SEED


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Tune the process noise of modes by likelihood or by position error.

    mmwave-loc tune --radio handset --out modes.json
    """

    radio: str = "handset"
    """handset, standard, high or a JSON file"""
    modes: tuple[str, ...] = ("ekf", "ukf")
    """what to tune: ekf, ukf, ckf, ekf-robust, ukf-robust, mode files"""
    scenarios: tuple[str, ...] = ("pedestrian", "vehicle")
    """kind of user each mode is tuned on, in the same order; names, JSON files or CSV files"""
    free: tuple[str, ...] = ("sigma_v", "sigma_p")
    """what to tune: sigma_p, sigma_v, sigma_pz, sigma_vz, sigma_b_mps, spread_gain"""
    objective: Literal["likelihood", "rmse"] = "likelihood"
    """likelihood of the measurements (needs no truth), or root mean square position error"""
    diagonal: bool = False
    """process noise as the paper prints it: a plain diagonal, no coupling"""
    episodes: int = 300
    """how many"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    out: Path | None = None
    """write the tuned modes to this mode file, for --modes and modes="""
