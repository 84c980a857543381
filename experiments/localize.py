"""mmwave-loc localize: the track of a recorded log, by the paper's Algorithm 1 or by an IMM."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from experiments.console.options import IntegrityArgs


@dataclass(kw_only=True)
class OutputArgs:
    """Results."""

    out: Path | None = None
    """write the track in TUM format, and a .csv with standard deviations and modes beside it"""
    plot: Path | None = None
    """draw the track to this .png, .svg or .pdf file"""
    json: Path | None = None
    """write every figure to this file"""
    diagnose: bool = False
    """tell epochs, rate, how often each anchor is seen and what is odd; then try likely mistakes on
    the first epochs (units, signs, ends, frames, order of anchors), and say which one makes the log
    consistent; no track"""


@dataclass(kw_only=True)
class FilterArgs:
    """Filters."""

    radio: str = "handset"
    """handset, standard, high or a JSON file: noise by SNR, and the tuning of the modes"""
    modes: Path | None = None
    """mode file with other pipelines: the one for low, then the one for high mobility"""
    imm: str | None = None
    """in place of one pipeline at a time, all modes of an IMM at once, mixed by how well each
    explains the log: imm-best, imm or a bank's mode file"""
    gating: bool = True
    """reject measurements outside their 99 % chi-square gates"""
    adaptive: bool = True
    """scale Q and R by the innovations"""
    smoothing: bool = True
    """Rauch-Tung-Striebel smoothing"""
    window: int = 200
    """epochs smoothed together"""
    robust: bool = False
    """doubt links far off instead of rejecting them; does without adaptive scaling"""
    odometry: bool = True
    """use speed and heading where the log has them"""
    height: float | None = None
    """flat terrain at this height, m"""


@dataclass(kw_only=True)
class Args(FilterArgs, IntegrityArgs, OutputArgs):
    """The track of a measurement log, by the paper's EKF and UKF pipelines (Algorithm 1).

    Up to 2 m/s the EKF pipeline runs, above it the UKF pipeline; or both, and more, in an IMM.

    mmwave-loc localize log.csv --scene scene.json --speed auto --out track.tum
    mmwave-loc localize log.csv --scene scene.json --imm imm-best --out track.tum
    """

    log: Positional[Path | None] = None
    """measurement log: .csv, .csv.gz or .parquet"""
    scene: str | None = None
    """JSON file with the anchors; or street, o1, dynamic-doppler"""
    sample: str | None = None
    """in place of a log: canyon28_vehicle or canyon28_pedestrian, with its scene and truth"""
    speed: str | None = None
    """of the user, m/s; or auto, to decide in every epoch, as where none is given"""
    outside: Literal["fallback", "abort"] = "fallback"
    """above 20 m/s, outside the design window: run the UKF pipeline, or stop"""
    follow: Literal["prediction", "odometry"] = "prediction"
    """the speed that --speed auto follows"""
    associate: bool = False
    """rows are paths that nobody has given an anchor: find out which belong to which, and which are
    false"""
    truth: Path | None = None
    """true track in TUM format, to score against; the filters never see it"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.reporting.log_results import localized

    localized(args)
