"""Options that several commands share, and their parser.

Help must appear at once, so this module imports nothing slow: it copies some constants of the
library, and a test checks that the copies agree.
"""

import inspect
import os
import re
import textwrap
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import tyro
from tyro.conf import Positional

USUAL_EPISODES = 1000
AUTO = "auto"  # --radio auto: the radio profile whose noise is nearest to the noise of a log
# first seeds of the episodes for tuning and for training; seeds of tests start at 0
TUNING_SEED = 5_000_000
TRAINING_SEED = 10_000_000
SEEDS_EACH = 1_000_000  # number of seeds reserved for the episodes of each training run


# line between the parts of tyro's messages, which have frames where the terminal shows UTF-8
RULE = re.compile("^(?: +-+ *|│ ─+ │|[╭╰].*)$", re.MULTILINE)
WRONG_TYPE = re.compile(
    r"^Error parsing (--[\w-]+): no type matching (.+) could be instantiated from \[(.*)\]"
)


def parsed(kind: type[Any], name: str, words: Sequence[str]) -> Any:
    """Return the options that words of a command line set; ``name`` is the command's name.

    Raises:
        ValueError: an option is wrong.
        SystemExit: with 0, after showing help.
    """
    config = (tyro.conf.DisallowNone, tyro.conf.PositionalMetavarFromFieldName)
    # tyro joins the lines of a paragraph, except lines that begin with a space.
    about = textwrap.indent(inspect.getdoc(kind) or "", " ")
    box = StringIO()
    try:
        with redirect_stderr(box):
            return tyro.cli(
                kind, prog=f"mmwave-loc {name}", description=about, args=words, config=config
            )
    except SystemExit as end:
        if end.code:
            raise ValueError(_message(box.getvalue())) from end
        raise


def _message(box: str) -> str:
    """Return, in one line, tyro's message about a mistake and the option that tyro suggests."""
    parts = [" ".join(part.replace("│", "").split()) for part in RULE.split(box)]
    message = parts[1].partition(" Got errors")[0]
    message = re.sub(r"^Missing from .*?: ", "required: ", message).rstrip(".")
    message = WRONG_TYPE.sub(r"\1: found \3, expected \2", message)
    message = re.sub(
        r"^Error parsing (.*): invalid.*: (.*)", r"\1: found \2, expected INT", message
    )
    close = re.match(r"Perhaps you meant: (--[\w-]+(, --[\w-]+)*)", parts[2])
    if close:
        return f"{message}; did you mean {close[1]}?"
    return f"{message}; --help lists all options"


def require_at_least(least: int, args: Any, *names: str) -> None:
    """Refuse the options with these names if they are numbers below ``least``."""
    for name in names:
        number = getattr(args, name)
        if number is not None and number < least:
            raise ValueError(f"{name}: found {number}, expected at least {least}")


def require_alone(args: Any, option: str, *others: str) -> None:
    """Refuse ``others`` beside ``option``, if none of the two has its default value."""
    for other in others:
        if all(getattr(args, name) != getattr(type(args), name) for name in (option, other)):
            raise ValueError(f"{other}: cannot be combined with --{option.replace('_', '-')}")


def require_default(args: Any, without: str, *names: str) -> None:
    """Refuse options that have no effect without another one."""
    for name in names:
        if getattr(args, name) != getattr(type(args), name):
            raise ValueError(f"{name}: found {getattr(args, name)} without {without}")


@dataclass
class JsonArgs:
    """Options for results in a file."""

    json: Path | None = None
    """write all results to this JSON file"""


@dataclass
class WorldArgs:
    """Options for streets, users and radio, as in the environment."""

    scenario: str | None = None
    """kind of user: pedestrian, vehicle, walk-ride (walks,
    rides a car, walks again), jam (stop-and-go traffic),
    cyclist, mixed (all of them in equal shares, also for
    None) or a JSON file; or trajectories of your own: a
    CSV file with columns t, x, y, z, and id if there are
    several users"""
    radio: str = "handset"
    """radio profile: handset (4 x 4 antennas at the base
    station, 2 x 2 at the user), standard (8 x 8, 4 x 4),
    high (16 x 16, 8 x 8) or a JSON file"""
    scene: str | None = None
    """street (default), o1, dynamic-doppler, random (a new
    scene in each episode) or a JSON file"""
    data: str | None = None
    """recorded data instead of a simulation: a ray-traced
    sample (canyon28_pedestrian, canyon28_stop_and_go,
    canyon28_vehicle or canyon28_walk_ride_walk), the folder
    of a DeepMIMO scenario (each seed draws new receiver
    noise and a new prior), or a folder with a measurement
    log, scene.json and truth.tum (each seed draws a new
    prior)"""
    dt: float | None = None
    """seconds between epochs (None: 1)"""
    episode_steps: int | None = None
    """number of epochs of an episode (None: 200, or all epochs of recorded data)"""
    odometry: bool = False
    """the user also measures speed and heading"""
    clock: str = "synchronized"
    """synchronized; offset: the user's clock has an unknown
    offset, which shifts all ranges; or free: the offset is
    another in every epoch (times of arrival of a clock that
    jumps, time differences)"""
    survey: str | None = None
    """bad: anchors' places, angles and ranges have errors
    that all links of an episode share (None: no errors)"""
    measurements: tuple[str, ...] | None = None
    """quantities that the receiver measures: some of range,
    azimuth, elevation, departure and doppler (None: all)"""


@dataclass
class ModeArgs(WorldArgs):
    """Options for modes and agents."""

    modes: tuple[str, ...] = ()
    """modes to use instead of the radio's ekf and ukf: names
    (ekf, ukf, ckf, ekf-robust, ukf-robust) and mode files.
    Policies that can use them: fixed-NAME,
    likelihood-rule, imm and, if there are two modes,
    speed-rule (the first for low mobility, the second for
    high). Learned policies keep their own modes"""
    observation: str = "full"
    """observation that your own agents get: full, prior or
    signed; policy files set their own"""
    beliefs: str = "shared"
    """beliefs (estimates) that your own agents were trained
    with: shared, or per-mode (the default modes are then
    the modes of the radio's best IMM); policy files set
    their own"""
    planar: bool = False
    """flat terrain: height and vertical velocity are known"""


@dataclass
class IntegrityArgs:
    """Options for protection levels, bounds that position errors rarely exceed."""

    risk: float = 0.001
    """probability that an error exceeds its protection level"""
    levels: Literal["calibrated", "gaussian"] = "calibrated"
    """protection levels: calibrated on simulated episodes
    (for a risk of 0.01 or 0.001), or gaussian (for any
    risk, if the covariances are right)"""


@dataclass
class EpisodeArgs(ModeArgs, IntegrityArgs, JsonArgs):
    """Options for the episodes to run, and for their results."""

    episodes_csv: Path | None = None
    """write a CSV table with one row per policy and episode, and one column per metric"""
    percentiles: bool = False
    """also show percentiles of horizontal and vertical
    errors, the shares of errors within some distances, and
    how often errors exceed their protection levels"""
    episodes: int = USUAL_EPISODES
    """number of episodes; results to publish need 1000 or more"""
    seed: int = 0
    """seed of the first episode; test seeds start
    at 0, tuning seeds at 5000000"""
    reward: str = "tracking"
    """reward to report: tracking or log-score"""


@dataclass
class CompareArgs(EpisodeArgs):
    """Compare policies on the same seeded episodes, with paired differences.

    Differences are paired, episode by episode. All metrics, including the reward,
    leave out the first 10 epochs of an episode. Every policy is paired with the
    references (best fixed mode, speed-rule, imm, imm-best). Your own agents and
    policy files are paired with all others. If no policy is a reference, all pairs
    are compared.

        mmwave-loc compare --policies fixed-ukf speed-rule imm ppo --episodes 200
    """

    policies: tuple[str, ...] = ()
    """fixed-NAME (a mode in every epoch: fixed-ekf, fixed-ukf
    or fixed-ckf); speed-rule (the paper's rule: EKF up to
    2 m/s, UKF above); likelihood-rule (the mode that
    explains recent measurements best); imm (interacting
    multiple models: mixes all modes) and imm-best (of five
    tuned modes); the learned ppo, guided, guided-ppo and
    corrector; policy files (.safetensors); folders of runs
    from `mmwave-loc train`; and module:function, a function
    without arguments that returns an agent. By default, all
    of these names run, but not clairvoyant, which knows the
    truth. If speed-rule (score 0) and clairvoyant (score
    100) both run, all policies get a score"""
    errors: Path | None = None
    """draw the distribution (CDF) of horizontal and of
    vertical errors to this .png, .svg or .pdf file"""
    consistency: Path | None = None
    """draw NEES over time, with its chi-square bounds, to this file"""


@dataclass
class LeaderboardArgs:
    """Judge policies and IMMs by the benchmark's protocol; rank all entries.

    A site is a street or a recording, with a radio. Contenders are not trained
    here. They run, together with the paper's rule and every IMM, at four kinds
    of sites: the nine sites where policies may be trained, unseen sites,
    recordings, and hard sites (unusual motion or receivers). A contender's
    entry (its results at all sites) is written to a JSON file in the folder
    --out. The tables show all entries in this folder, and four shipped entries,
    ranked by their gains over imm-best at the sites to train in; the last table
    has the scores. One of the entries is for the clairvoyant, a policy that
    knows the truth; its score is 100 by definition.

        mmwave-loc leaderboard --policies imm-best --episodes 400 --draws 20
    """

    policies: tuple[str, ...] = ()
    """contenders, as in mmwave-loc compare; if none is named,
    only existing entries are shown"""
    episodes: int = 2000
    """number of episodes on each simulated street"""
    draws: int = 200
    """number of draws of receiver noise on each recording"""
    seed: int = 0
    """seed of the first episode; test seeds, for reported results, start at 0"""
    out: Path = Path("results/leaderboard")
    """folder of entries, one JSON file each"""
    keep: bool = False
    """skip the policies that already have an entry in the
    folder; judge the others one by one, and write each
    entry when it is ready, so that the same command
    continues after an interruption"""
    verify: tuple[Path, ...] = ()
    """entries (JSON files) to verify: their policies play
    again at two sites, the claimed episodes and 50 of
    seeds drawn at random, and must reach their figures"""


@dataclass
class TaskArgs:
    """Options for the task to learn."""

    scenario: str = "mixed"
    """kind of user, as for compare: a name or a JSON file; or
    a trajectory of your own: a CSV file with columns t, x,
    y, z"""
    beliefs: Literal["shared", "per-mode"] = "shared"
    """shared: all modes work on one belief (estimate);
    per-mode: every mode keeps its own belief, and an
    action raises the probability of one mode, or of none"""
    modes: tuple[str, ...] = ()
    """modes to choose from: names and mode files; by default
    the radio's ekf and ukf or, with --beliefs per-mode,
    its best bank"""
    observation: str = "full"
    """features that the agent observes: full; prior (without
    the features that say how well each mode explains the
    coming epoch); or signed (full, plus residuals along
    and across velocity)"""
    algo: Literal["ppo", "rollouts", "corrector", "two-way"] = "ppo"
    """ppo: PPO of Stable-Baselines3; rollouts: rollout policy
    iteration with common random numbers, which tries every
    action on the same measurements; corrector: a recurrent
    network that corrects the beliefs of the policy
    `guided`; two-way: the network of localize --two-way,
    which corrects smoothed tracks"""
    radio: str = "handset"
    """radio to train with on the street, if --places is not
    given: handset, standard, high or a JSON file"""
    places: tuple[str, ...] = ()
    """places to train at, instead of --radio. Each is
    SCENE:RADIO (names or JSON files), such as
    street:handset, followed if needed by the seconds
    between epochs (:0.1, default: 1). Environments, and
    the episodes to judge policies on, are spread evenly
    over the places"""
    reward: Literal["tracking", "log-score"] = "tracking"
    """tracking or log-score. If a hyperparameter file sets
    "paired": true, as those for ppo do, the reward of an
    IMM (with --beliefs per-mode, the IMM of the bank) is
    subtracted"""
    nees_weight: float = 0.2
    """weight of the NEES in the tracking reward"""


@dataclass
class TrainArgs(TaskArgs):
    """Train policies that choose filters, with several seeds.

    The best policy of each seed is kept.

        mmwave-loc train --seeds 2 --total-timesteps 500000 --out runs/short
    """

    seeds: int = 5
    """number of training runs, one per seed"""
    total_timesteps: int | None = None
    """length of each training run, rounded up to complete
    updates: for --algo ppo, the number of steps of
    environments (None: 4000000); for corrector or two-way,
    the number of epochs that the network learns from, each
    of them three (corrector) or eight times (None:
    110000000, 64000000); for rollouts, the number of states
    in which every action is tried (None: 1200000)"""
    hyperparameters: Path | None = None
    """JSON file of hyperparameters, instead of the
    algorithm's default file in experiments/training, such
    as ppo.json or, with --beliefs per-mode,
    guided-ppo.json"""
    jobs: int = min(2, os.cpu_count() or 1)
    """number of training runs in parallel"""
    out: Path = Path("runs/train")
    """output folder: one folder per seed, policy.safetensors
    (from the seed with the median reward) and summary.json"""
    resume: bool = False
    """continue the training in the folder --out, from the last
    evaluations; the options must be the same as at its
    start"""


@dataclass
class TuneArgs:
    """Tune the process noise of modes by the likelihood of measurements.

    With --bank, tune a bank: the five modes of imm-best and the probabilities of
    changes between them. The reward of the bank's IMM in all scenes, at 1 and 10
    Hz, is maximized. With --levels, train and calibrate the protection levels
    anew. --bank needs the extra "tune"; --levels needs "train".

        mmwave-loc tune --radio handset --out modes.json
        mmwave-loc tune --bank --radio phone.json --episodes 900 --out bank.json
        mmwave-loc tune --levels --out mmwave_env/data/levels.safetensors
    """

    radio: str = "handset"
    """radio profile: handset, standard, high or a JSON file"""
    modes: tuple[str, ...] = ("ekf", "ukf")
    """modes to tune: ekf, ukf, ckf, ekf-robust, ukf-robust, mode files"""
    scenarios: tuple[str, ...] = ("pedestrian", "vehicle")
    """kinds of users to tune on, one for each mode, in the
    same order: names, JSON or CSV files"""
    free: tuple[str, ...] = ("sigma_v", "sigma_p")
    """parameters to tune: sigma_p, sigma_v, sigma_pz, sigma_vz, sigma_b_mps, spread_gain"""
    diagonal: bool = False
    """use the paper's printed process noise, a diagonal matrix without coupling"""
    episodes: int = 300
    """number of episodes to tune on"""
    seed: int = TUNING_SEED
    """seed of the first episode; never a test seed"""
    bank: bool = False
    """tune a bank instead of single modes"""
    evaluations: int = 1000
    """with --bank, maximum number of banks to try"""
    levels: bool = False
    """train the network of the protection levels on training
    seeds, and calibrate it on tuning seeds, with the
    shipped policies; the only other options are --seed
    and --out, which is required"""
    out: Path | None = None
    """mode file to write, which `--modes` and the
    environment's `modes` accept; with --levels, file
    (.safetensors) of the network to write"""


@dataclass
class LogArgs(IntegrityArgs, JsonArgs):
    """Compute the track of a measurement log, recorded or live.

    By default, a learned policy weighs several filters in every epoch. Two
    alternatives are the paper's Algorithm 1 (EKF up to 2 m/s, UKF above) and an
    IMM, which weighs the filters by itself.

        mmwave-loc localize log.csv --scene scene.json --out track.tum track.gpx
        mmwave-loc localize log.csv --scene scene.json --speed auto --out track.tum
        mmwave-loc localize - --live --scene scene.json
    """

    out: tuple[Path, ...] = ()
    """write the track to these files: .tum, which also writes
    a .csv with standard deviations and modes; .csv alone;
    or, for maps, .geojson, .gpx or .nmea, which need an
    origin in the scene"""
    plot: Path | None = None
    """draw the track to this .png, .svg or .pdf file"""
    diagnose: bool = False
    """compute no track, but show the number of epochs, the
    rate, how often each anchor is measured, and anything
    odd; then show likely mistakes in the first epochs
    (wrong units, signs, frames or order of anchors;
    arrival and departure swapped; errors that all links
    share, such as a turned frame), and which correction
    helps"""
    write: Path | None = None
    """with --diagnose, write the corrected scene to this
    .json file"""
    policy: str | None = None
    """policy that chooses the modes: corrector (default),
    guided, ppo, a policy file, or module:function"""
    imm: str | None = None
    """IMM to use instead of a policy: imm-best, imm or the
    mode file of a bank. An IMM runs all its modes, and
    weights each by how well it explains the log"""
    climb: float | None = None
    """with --imm, vertical velocity noise of all modes,
    (m/s) / sqrt(s): 0.1 for vehicles on hills, 0.3 for
    stairs and drones (shipped banks: 0.03)"""
    radio: str = AUTO
    """radio profile, which sets how modes are tuned and how
    noise depends on the SNR: handset, standard, high or a
    JSON file; auto: handset for paths, else the profile
    nearest to the log's noise"""
    snr: float | None = None
    """SNR of links that have none in the log, dB; needed if
    the log has neither SNR nor standard deviations"""
    smoothing: bool = True
    """smooth the track, or each mode's track if modes
    interact (Rauch-Tung-Striebel smoother)"""
    window: int = 200
    """number of epochs that are smoothed together"""
    two_way: bool = False
    """correct the smoothed track by a network that reads it
    forwards and backwards; needs a policy or an IMM"""
    odometry: bool = True
    """use speed and heading if the log has them"""
    height: float | None = None
    """known height of a user on flat terrain, m"""
    start: str | None = None
    """X,Y of a place near the user at first, m: needed if
    anchors on a line measure ranges alone, because a
    mirrored position fits as well; replaces side in the
    scene"""
    clock: str = "synchronized"
    """synchronized; offset: estimate the offset of the
    user's clock, which shifts all ranges; or free: the
    offset is another in every epoch (a clock that jumps;
    always so for time differences, columns rstd)"""
    correlation: float = 0.0
    """time for which errors of measurements last, s: at
    shorter steps, measurements get so much more noise"""
    prior_speed: float | None = None
    """standard deviation of the user's velocity at first, per
    axis, m/s, such as 1 for people who stand or stroll; it
    replaces start_velocity_mps of the radio (10)"""
    # If an option of Algorithm 1 is set (speed to robust), the algorithm replaces the policy.
    speed: str | None = None
    """Algorithm 1: the user's speed, m/s, which selects the
    pipeline that runs; or auto, to decide in every epoch"""
    outside: Literal["fallback", "abort"] = "fallback"
    """action if --speed is above 20 m/s, outside the paper's
    design window: fallback (run the UKF pipeline) or abort"""
    follow: Literal["prediction", "odometry"] = "prediction"
    """speed by which --speed auto decides: predicted by the
    filter, or measured by odometry"""
    modes: Path | None = None
    """mode file whose two modes replace the EKF (low
    mobility) and the UKF (high mobility)"""
    robust: bool = False
    """give outlying links less weight instead of rejecting them (also with --imm)"""
    log: Positional[Path | None] = None
    """measurement log: .csv, .csv.gz or .parquet; - for standard input, with --live"""
    scene: str | None = None
    """scene of the log: a JSON file with the anchors; or street, o1, dynamic-doppler"""
    sample: str | None = None
    """sample to use instead of a log, with a scene and
    ground truth: canyon28_vehicle, canyon28_pedestrian
    or, with --map learn or --associate, street_paths"""
    live: bool = False
    """read rows from standard input (log -) as CSV or JSON
    lines, and print a JSON line immediately after each
    epoch"""
    format: Literal["lines", "3gpp"] = "lines"
    """with --live, what to print: positions in the scene's
    frame, or LocationData of 3GPP TS 29.572, which needs an
    origin in the scene"""
    confidence: float = 0.95
    """with --format 3gpp, probability that the user is in the
    ellipse that is printed"""
    accuracy: float | None = None
    """with --format 3gpp, also tell whether the longer half
    axis of the ellipse is at most this many meters"""
    associate: bool = False
    """the log's rows are paths without anchor numbers: assign
    each path to an anchor, or reject it as false"""
    map: Literal["known", "learn"] = "known"
    """known: the scene has all anchors; learn: the scene has
    at least the base station; its mirror images are
    learned from the log's paths (rows without anchor
    numbers), then paths are assigned as by --associate"""
    map_out: Path | None = None
    """with --map learn, write the scene with the learned
    images to this .json file"""
    more: Positional[tuple[Path, ...]] = ()
    """with --map learn, more logs of the same place: the map
    is learned from all logs in order, and the track is that
    of the last"""
    truth: Path | None = None
    """ground-truth track in TUM format, to score the track; the filters never see it"""


@dataclass
class PageArgs:
    """Make one web page of results, which a browser shows offline.

    The page says which policy won by how much, and has tables and episodes to
    play. Results are JSON files (--json) of the commands compare, demo and
    localize. Results do not store single epochs, so the command runs episodes
    again, with the stored options. Agents in your own code (module:function) are
    not run again: the page lacks their episodes, or the playback of their track.

        mmwave-loc report results.json --out report.html
    """

    results: Positional[tuple[Path, ...]]
    """JSON files of results"""
    out: Path = Path("report.html")
    """web page to write"""
    episodes: int = 2
    """number of episodes of each comparison to run again, which
    the page can play epoch by epoch; 0 for none"""
