"""Options of mmwave-loc watch."""

from dataclasses import dataclass
from pathlib import Path

from experiments.arguments.shared import ModeArgs
from mmwave_env.rendering.frames import FRAMES_PER_SECOND, SMALLEST


@dataclass(kw_only=True)
class PlayArgs(ModeArgs):
    """Episode."""

    seed: int | None = None
    """seed of the episode (0 where none is given), the same that evaluate runs"""
    key: int | None = None
    """key of a simulated episode in place of a seed, as --episodes-csv of compare tells it"""
    log: Path | None = None
    """measurement log (.csv, .csv.gz or .parquet) to play in place of an episode, with --scene; no
    truth is needed; as of localize, a track begins at the first line of sight"""
    begin: float | None = None
    """second of the episode to begin at; the beginning where none is given"""
    end: float | None = None
    """second of the episode to end at; the end where none is given"""
    clearest: int | None = None
    """look among so many episodes, of seeds from 5000000 or --seed on, for the pull-away after a
    stop in which the first policy falls farthest behind the last, and play the seconds around it"""


@dataclass(kw_only=True)
class PictureArgs(PlayArgs):
    """Pictures."""

    out: Path | None = None
    """write a video, a .gif or .mp4 file, in place of a window"""
    fps: int = FRAMES_PER_SECOND
    """epochs a second; in a window, keys change it (h lists them)"""
    render_size: int = SMALLEST
    """height and width of the picture of a policy, px, 480 to 1080"""
    render_theme: str = "light"
    """light or dark"""


@dataclass(kw_only=True)
class Args(PictureArgs):
    """Play an episode as policies go through it, one beside the other, in a window or as a video.

    mmwave-loc watch --policies speed-rule ppo --seed 3 --out ride.gif
    """

    policies: tuple[str, ...] = ("speed-rule", "ppo")
    """up to three, as of compare: names of mmwave-loc list policies, policy files (.safetensors),
    folders of runs, models of Stable-Baselines3 (.zip, with --trust-zip) and module:function"""
