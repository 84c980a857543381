"""Options of mmwave-loc tune-imm."""

from dataclasses import dataclass
from pathlib import Path

from experiments.evaluation.seeds import TUNING_SEED
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from policies import TUNED_IMMS


@dataclass(kw_only=True)
class Args:
    """Tune IMMs per radio profile, by mean reward: transition and, of two modes, process noise.

    With --banks everything of a bank of modes that is data, by CMA-ES (extra "tune").

    mmwave-loc tune-imm --radios handset --imms imm-tuned --json imms.json
    mmwave-loc tune-imm --radios handset --banks maneuvers --out banks
    """

    scenario: str = "mixed"
    """kind of user: a name, a JSON file or a CSV file"""
    radios: tuple[str, ...] = tuple(RADIOS)
    """radio profiles: names or JSON files"""
    imms: tuple[str, ...] = tuple(TUNED_IMMS)
    """imm-tuned (of ekf, ukf), imm-robust (of ekf-robust, ukf-robust), imm-extended (of eight): the
    transition; with -limited after the name the process noise of two modes as well, and outliers
    count in the likelihoods up to a quantile"""
    banks: tuple[str, ...] = ()
    """in place of IMMs: maneuvers, two, three, proportional, doubting, reacquire or two-levels;
    each is compared with the first"""
    scenes: tuple[str, ...] = tuple(SCENES)
    """where the episodes of banks are, in equal shares; IMMs are tuned on the street"""
    steps: tuple[float, ...] = (1.0, 0.1)
    """seconds between the epochs of banks, in equal shares; those of IMMs are 1 s apart"""
    episodes: int = 1000
    """how many"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    held_out: int = 1000
    """how many of the seeds that follow show whether it holds"""
    evaluations: int = 1000
    """at most, per IMM"""
    json: Path | None = None
    """write the results here, beside those it holds; policies/data/imms.json is such a file"""
    out: Path | None = None
    """folder for a bank file a radio, as mmwave_env/data/banks has them"""
    docs: Path | None = None
    """also renew the tables of this page, a radio each, between its `<!-- table: ... -->` lines"""
