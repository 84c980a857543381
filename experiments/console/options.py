"""Options that several commands share.

Help must appear at once, so this module imports nothing slow: it repeats numbers of the library,
and a test compares them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

USUAL_EPISODES = 1000
AUTO = "auto"  # the radio whose noise is nearest to a log's
TUNING_SEED = 5_000_000  # the first seed for tuning


@dataclass(kw_only=True)
class JsonArgs:
    """Results."""

    json: Path | None = None
    """write every figure to this file"""


@dataclass(kw_only=True)
class EpisodeResultArgs(JsonArgs):
    """Results."""

    episodes_csv: Path | None = None
    """write every metric of every policy and episode to this table, a row each"""
    percentiles: bool = False
    """also show percentiles of horizontal and vertical errors, shares within a distance, and how
    often errors exceed their protection levels"""


@dataclass(kw_only=True)
class WorldArgs:
    """Options of streets, users and radio, as in the environment."""

    scenario: str | None = None
    """kind of user, by name (mmwave-loc list scenarios; mixed where none is named) or from a JSON
    file; or ways of your own, a CSV file with columns t, x, y, z, and id
    where there are several users"""
    radio: str = "handset"
    """handset, standard, high or a JSON file"""
    scene: str | None = None
    """street (where none is named), o1, dynamic-doppler, random (each episode its own) or a JSON
    file"""
    data: str | None = None
    """recorded data instead of a simulation: one of mmwave-loc list samples, or a folder, of
    a DeepMIMO scenario (each seed draws receiver noise and prior anew) or of a measurement log with
    scene.json and truth.tum (each draws the prior anew)"""
    dt: float | None = None
    """seconds between epochs (1 where none is given)"""
    episode_steps: int | None = None
    """epochs of an episode (200 where none is given; all of recorded data)"""
    odometry: bool = False
    """the user measures speed and heading, too"""
    clock: str = "synchronized"
    """synchronized, or offset: the user's clock has an unknown offset, which ranges see"""


@dataclass(kw_only=True)
class ModeArgs(WorldArgs):
    """Modes and agents."""

    modes: tuple[str, ...] = ()
    """modes to work with in place of the profile's ekf and ukf: names (ekf, ukf, ckf, ekf-robust,
    ukf-robust) and mode files; policies are then fixed-NAME, likelihood-rule, imm and, with two
    modes, speed-rule, which takes the first for low and the second for high mobility; learned
    policies bring their own modes"""
    observation: str = "full"
    """what agents of your own were trained with: full, or prior; policy files say it themselves"""
    beliefs: str = "shared"
    """what agents of your own were trained with: shared, or per-mode, where the modes are those of
    the radio's best IMM if none are named; policy files say it themselves"""
    planar: bool = False
    """flat terrain: height and vertical velocity are known"""


@dataclass(kw_only=True)
class IntegrityArgs:
    """Integrity."""

    risk: float = 0.001
    """that an error exceeds its protection level, if covariances are right"""


@dataclass(kw_only=True)
class EpisodeArgs(ModeArgs, IntegrityArgs, EpisodeResultArgs):
    """Episodes."""

    episodes: int | None = None
    """how many (1000 where none is given); 1000 or more to publish"""
    seed: int | None = None
    """seed of the first episode (0 where none is given); test seeds start at 0, tuning seeds at
    5000000"""
    reward: str = "tracking"
    """tracking or log-score"""


@dataclass(kw_only=True)
class TaskArgs:
    """Options of the task to learn."""

    algo: Literal["ppo", "rollouts"] = "ppo"
    """ppo is that of Stable-Baselines3; rollouts is rollout policy iteration with common random
    numbers: every action is tried on the same measurements"""
    scenario: str = "mixed"
    """kind of user, by name (mmwave-loc list scenarios) or from a JSON file; or a way of your own,
    a CSV file with columns t, x, y, z"""
    radio: str = "handset"
    """handset, standard, high or a JSON file: of the street, where no places are named"""
    places: tuple[str, ...] = ()
    """one or more of SCENE:RADIO and SCENE:RADIO:DT in place of a radio, such as street:handset and
    o1:standard:0.1: names or JSON files, and the seconds between epochs, 1 where left out; the
    environments and the episodes that policies are judged on are spread over them evenly"""
    beliefs: Literal["shared", "per-mode"] = "shared"
    """per-mode: every mode keeps its own belief, and the agent says which of them to trust"""
    modes: tuple[str, ...] = ()
    """to choose from: names and mode files; the radio's ekf and ukf by default, and its
    best bank with beliefs per mode"""
    observation: str = "full"
    """full, or prior: nothing of how each mode sees the coming epoch"""
    reward: str = "tracking"
    """tracking or log-score, minus the IMM's where the hyperparameters say paired; or paired, which
    always is tracking minus the IMM's: of the bank, with beliefs per mode"""
    nees_weight: float = 0.2
    """weight of the NEES in the tracking reward"""


@dataclass(kw_only=True)
class TrackOutputArgs:
    """Results."""

    out: Path | None = None
    """write the track: .tum (with a .csv of standard deviations and modes beside it), that .csv
    alone, or, for a map, .geojson, .gpx or .nmea, which need an origin in the scene"""
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

    policy: str | None = None
    """who chooses the modes: guided (where nothing else is named), ppo, a policy file, or
    module:function"""
    imm: str | None = None
    """in place of a policy, all modes of an IMM, mixed by how well each explains the log: imm-best,
    imm or a bank's mode file"""
    radio: str = AUTO
    """noise by SNR, and the tuning of the modes: handset, standard, high or a JSON file; auto takes
    the profile whose noise is nearest to the log's"""
    snr: float | None = None
    """of links without one, dB: needed where the log states neither SNR nor standard deviations"""
    smoothing: bool = True
    """smooth the track: Rauch-Tung-Striebel, and mode by mode where several interact"""
    window: int = 200
    """epochs smoothed together"""
    odometry: bool = True
    """use speed and heading where the log has them"""
    height: float | None = None
    """flat terrain at this height, m"""
    clock: str = "synchronized"
    """of the user; offset where ranges have its unknown offset, which is then estimated, too"""


@dataclass(kw_only=True)
class AlgorithmArgs:
    """The paper's Algorithm 1, in place of a policy; any of these asks for it."""

    speed: str | None = None
    """Algorithm 1: speed of the user, m/s, by which one pipeline runs; or auto, to decide in every
    epoch"""
    outside: Literal["fallback", "abort"] = "fallback"
    """above 20 m/s, outside the design window: run the UKF pipeline, or stop"""
    follow: Literal["prediction", "odometry"] = "prediction"
    """the speed that --speed auto follows"""
    modes: Path | None = None
    """mode file with other pipelines: the one for low, then the one for high mobility"""
    gating: bool = True
    """reject measurements outside their 99 % chi-square gates (also of --imm)"""
    adaptive: bool = True
    """scale Q and R by the innovations (also of --imm)"""
    robust: bool = False
    """doubt links far off instead of rejecting them (also of --imm)"""


@dataclass(kw_only=True)
class LogArgs(AlgorithmArgs, FilterArgs, IntegrityArgs, TrackOutputArgs):
    """Log, scene and truth."""

    log: Positional[Path | None] = None
    """measurement log: .csv, .csv.gz or .parquet; - for standard input, with --live"""
    scene: str | None = None
    """JSON file with the anchors; or street, o1, dynamic-doppler"""
    sample: str | None = None
    """in place of a log: canyon28_vehicle or canyon28_pedestrian, with its scene and truth"""
    live: bool = False
    """read rows from standard input (log -), CSV or JSON lines, and print one JSON line per epoch
    at once"""
    lag: int = 0
    """with --live, also print the position this many epochs ago, smoothed by those since"""
    associate: bool = False
    """rows are paths that nobody has given an anchor: find out which belong to which, and which are
    false"""
    truth: Path | None = None
    """true track in TUM format, to score against; the filters never see it"""


@dataclass(kw_only=True)
class PageArgs:
    """Results and episodes of a web page."""

    results: Positional[tuple[Path, ...]]
    """JSON files of results, and folders of runs"""
    out: Path = Path("report.html")
    """file to write"""
    episodes: int = 30
    """of each comparison to play again, for the distributions of errors and NEES; 0 for none"""
    watch: int = 2
    """how many of these can be watched epoch by epoch"""
