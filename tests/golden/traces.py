"""Golden traces: what filters, smoother, environments and comparisons compute, to the last bit.

A change that is to move no number leaves the files as they are (test_golden.py); where numbers
are to change, a diff of the files shows which. A *kind* is a function that returns its files as
{name: text}; a file's name begins with its kind and a dot. What shares compiled programs is one
kind, because compiling takes longest.
"""

import contextlib
import io
import json
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import mmwave_env
from experiments.cli.main import run
from experiments.speed.operations import Operations, count
from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.imm_engine import ImmEngine, imm_program
from mmwave_env.engines.track_engine import Tracker
from mmwave_env.episodes.episode import Episode
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.filters.bank import best_bank
from mmwave_env.filters.imm import begin
from mmwave_env.filters.mode_files import default_modes, named_modes
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.filters.smoother import SMOOTHING_WINDOW
from mmwave_env.localization.localizer import TrackBlock, localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.prior import prior_from_fix
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import read_scene, scene_from
from mmwave_env.numerics.pytree import unflatten
from mmwave_env.reward import TrackingReward
from mmwave_env.vector_env import MmWaveLocVectorEnv
from tests.golden.rollouts import ROLLOUTS, rollout
from tests.golden.text import table

Files = dict[str, str]

LOGS = Path(mmwave_env.__file__).parent / "data" / "logs"
NAMES = ("canyon28_pedestrian", "canyon28_vehicle")
MODES = ("ekf", "ukf", "ckf", "ekf-robust", "ukf-robust")
RADIO = "standard"  # of the receiver that measured the logs
STATE = ("px", "py", "pz", "vx", "vy", "vz", "b")
DIAGONAL = [i * (i + 3) // 2 for i in range(7)]  # of a packed covariance
EVERY_EPOCH, THEN_EVERY = 120, 12  # of a track: all of the shorter log


# --- tracks of the measurement logs


def track(mode: str) -> Files:
    """The filtered track of every log in a mode."""
    return {f"track-{mode}.{log}.csv": _track(log, mode) for log in NAMES}


def _track(log: str, mode: str) -> str:
    block = localized(log, mode)
    columns = _belief(block.x, block.P)
    columns |= _groups("nis", block.nis)
    flags = gates(block.visible, block.accepted)
    return _epochs(f"{log}, mode {mode}", columns, {"gates": flags})


def localized(log: str, mode: str, window: int | None = None) -> TrackBlock:
    """The track of a log in a mode: one block, one segment."""
    scene = read_scene(LOGS / log / "scene.json")
    blocks = read_log(LOGS / log / "log.csv", scene)
    modes = [named_modes(RADIO)[mode]]
    (block,) = localize(blocks, scene, radio_from(RADIO), modes, window=window)
    return block


def track_imm() -> Files:
    """The track of every log by the IMM over the default modes."""
    return {f"track-imm.{log}.csv": _track_imm(log) for log in NAMES}


def _track_imm(log: str) -> str:
    episode, modes = _episode(log), default_modes(RADIO)
    pipeline = Pipeline(modes, episode.layout)
    told = ImmEngine(pipeline, TrackingReward()).run(
        [episode], "x", "P", "mixture.probability", "mixture.tracks"
    )
    x, P, probability, mixed = (values[0] for values in told.values())
    tracks = unflatten(begin(pipeline, [0.0] * 7, [0.0] * 28).tracks, iter(mixed.T))
    columns, flags = _belief(x, P), {}
    for mode, share, one in zip(modes, probability.T, tracks, strict=True):
        columns[f"probability {mode.name}"] = share
        columns |= _groups(f"nis {mode.name}", np.transpose(one.memory.nis))
        flagged = one.memory.accepted, one.memory.rejected
        accepted, rejected = (np.transpose(flag) > 0.5 for flag in flagged)
        flags[f"gates {mode.name}"] = gates(accepted | rejected, accepted)
    return _epochs(f"{log}, IMM", columns, flags)


def _episode(log: str) -> Episode:
    """A log as an episode, from the fix of its first epoch."""
    scene, radio = read_scene(LOGS / log / "scene.json"), radio_from(RADIO)
    (block,) = read_log(LOGS / log / "log.csv", scene)
    sigma, visible = radio.sigma(block.snr_db, scene, block.layout), block.visible.copy()
    fix = block.measurement[0, :4], sigma[0, :4]
    mean, covariance = prior_from_fix(scene.anchors_m[0], *fix, radio, scene)
    visible[0, 0] = False  # or the link would be used twice
    return Episode(
        log, scene.anchors_m, scene.hz_per_mps, block.time_s, block.measurement, sigma, visible,
        block.snr_db, block.doppler_spread_hz, mean, covariance, None, None, block.layout,
    )  # fmt: skip


def smoother() -> Files:
    """Smoothed means and variances of a track, in windows."""
    log, mode = NAMES[0], "ekf"
    block = localized(log, mode, SMOOTHING_WINDOW)
    columns = _belief(block.smooth_x, block.smooth_P)
    return {f"smoother.{log}.csv": _epochs(f"{log}, mode {mode}, smoothed", columns, {})}


def _belief(x: Any, P: Any) -> dict[str, Any]:
    """Columns of a state (T, 7) and of the diagonal of its packed covariance (T, 28)."""
    variances = {f"var {name}": P[:, at] for name, at in zip(STATE, DIAGONAL, strict=True)}
    return {name: x[:, i] for i, name in enumerate(STATE)} | variances


def _groups(what: str, values: Any) -> dict[str, Any]:
    """Columns of a number (T, groups) of every group of a measurement."""
    return {f"{what} {group}": column for group, column in enumerate(values.T)}


def gates(visible: Any, accepted: Any) -> list[str]:
    """For every epoch (T,) a letter a group: accepted, rejected, or - where it is missing."""
    return [
        "".join("-ra"[seen + taken] for seen, taken in zip(*epoch, strict=True))
        for epoch in zip(visible.astype(int), (visible & accepted).astype(int), strict=True)
    ]


def _epochs(what: str, columns: dict[str, Any], flags: dict[str, Sequence[str]]) -> str:
    """Epochs of a track as a table: numbers of some, flags (words) of all since the row before."""
    T = len(columns["px"])
    shown = [k for k in range(T) if k < EVERY_EPOCH or k % THEN_EVERY == 0 or k == T - 1]

    def rows() -> Iterator[dict[str, object]]:
        for before, k in pairwise([-1, *shown]):
            since = {name: " ".join(words[before + 1 : k + 1]) for name, words in flags.items()}
            yield {"epoch": k} | {name: column[k] for name, column in columns.items()} | since

    if flags:
        what += "; gates (a accepted, r rejected, - missing) of all epochs since the row before"
    return table(what, ["epoch", *columns, *flags], rows())


# --- environments, and policies in them


def rollouts(group: str) -> Files:
    """The rollouts of a group, whose environments share a compiled program."""
    return {f"rollout-{group}.{name}.csv": rollout(**it) for name, it in ROLLOUTS[group].items()}


def compare() -> Files:
    """The figures that ``mmwave-loc compare`` writes; how they were made is no figure."""
    policies = ("fixed-ekf", "fixed-ukf", "speed-rule", "likelihood-rule", "imm", "ppo")
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        file = Path(folder, "compare.json")
        with contextlib.redirect_stdout(io.StringIO()):
            run("compare", ["--episodes", "20", "--json", str(file), "--policies", *policies])
        written = json.loads(file.read_text(encoding="utf-8"))
    figures = {key: part for key, part in written.items() if key not in ("command", "versions")}
    return {"compare.mixed-handset.json": json.dumps(figures, indent=2) + "\n"}


# --- what it costs: a gate without clocks


def operations() -> Files:
    """SIMD instructions of every kernel, each on eight environments."""
    rows = ({"kernel": name} | count(*it)._asdict() for name, it in _kernels().items())
    what = "instructions of a kernel on eight environments"
    return {"operations.csv": table(what, ["kernel", *Operations._fields], rows)}


def _kernels() -> dict[str, tuple[Callable[[Any], Any], Any]]:
    """A function of numbers and its workspace, by name."""
    source = SimulatedSource(scene_from("street"), radio_from("handset"))
    modes, reward, bank = named_modes("handset"), TrackingReward(), best_bank()
    both, five = (Pipeline(some, source.layout) for some in (default_modes(), bank.modes))
    programs: dict[str, Any] = {
        f"track {name}": Tracker(Pipeline((modes[name],), source.layout), 1).program
        for name in MODES
    }
    programs["step, shared beliefs"] = Engine(both, 1, reward).batch.program
    programs["step, per-mode beliefs"] = Engine(five, 1, reward, bank=bank).batch.program
    programs["IMM of five modes"] = imm_program(five, reward)
    kernels = {name: (one.function, one.template) for name, one in programs.items()}
    parts = ("measured", "something happens", "a substep")
    for name, part in zip(parts, source.world.parts, strict=True):
        kernels[f"world: {name}"] = part, source.world.template
    return kernels


def memory() -> Files:
    """Bytes that an environment keeps from step to step, one among 64."""
    rows = []
    for beliefs in ("shared", "per-mode"):
        env = MmWaveLocVectorEnv(64, beliefs=beliefs)
        env.reset(seed=0)
        kept = {name: array.nbytes // 64 for name, array in env.state().items()}
        kept["together"] = sum(kept.values())
        rows += [{"array": f"{beliefs}: {name}", "bytes": size} for name, size in kept.items()]
    return {"memory.csv": table("bytes of an environment", ["array", "bytes"], rows)}


KINDS: dict[str, Callable[[], Files]] = {
    **{f"track-{mode}": partial(track, mode) for mode in MODES},
    "track-imm": track_imm,
    "smoother": smoother,
    **{f"rollout-{group}": partial(rollouts, group) for group in ROLLOUTS},
    "compare": compare,
    "operations": operations,
    "memory": memory,
}
