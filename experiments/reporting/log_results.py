"""Localization of a recorded log by the paper's Algorithm 1 or by an IMM."""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.console.options import LogArgs
from experiments.console.progress import progress
from experiments.console.provenance import provenance
from experiments.console.tables import show
from experiments.evaluation.contenders import imm_banks
from experiments.figures.canvas import require_picture
from experiments.figures.trajectory import draw_trajectory
from experiments.reporting.log_diagnosis import diagnosed
from experiments.reporting.track_report import TrackSampler, track_markdown
from mmwave_env.datasets.log_folder import LOG, SCENE, TRUTH
from mmwave_env.datasets.samples import sample_folder
from mmwave_env.engines.track_engine import Rule
from mmwave_env.filters.bank import Bank, bank_from, modes_from
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS, Mode, robust
from mmwave_env.io.files import require_writable, write_json
from mmwave_env.io.lookup import choose
from mmwave_env.localization.association import Association, associate
from mmwave_env.localization.contradictions import contradictions
from mmwave_env.localization.localizer import TrackBlock, localize
from mmwave_env.localization.position_errors import require_risk
from mmwave_env.localization.track_files import require_own_files, table_beside, track_files
from mmwave_env.localization.track_scores import Course, Groups, TruthScores
from mmwave_env.logs.clock import clock_offset, keeping
from mmwave_env.logs.lines import number
from mmwave_env.logs.log import LogBlock, read_log, read_paths
from mmwave_env.logs.log_tables import LogError
from mmwave_env.logs.truth import Truth
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.models.scene import Scene, scene_from
from policies.speed_rule import SLOW_MPS, by_odometry_speed, by_predicted_speed, mode_at

EPOCHS_PER_BLOCK = 1 << 14
LONGEST_WINDOW = 20_000  # epochs; a window is held in memory
RULES: dict[str, tuple[Rule, str]] = {  # with the speed that each follows
    "prediction": (by_predicted_speed, "the predicted"),
    "odometry": (by_odometry_speed, "odometry's"),
}


class Inputs(NamedTuple):
    """Files to read, from the command line or from a sample."""

    log: Path
    scene: str
    truth: Path | None


class ModePlan(NamedTuple):
    """Modes to run, with the rule between two modes or a bank, and the reason in words."""

    modes: Sequence[Mode] | Bank
    rule: Rule | None
    why: str

    @property
    def names(self) -> list[str]:
        """Return the names of the modes."""
        modes = self.modes.modes if isinstance(self.modes, Bank) else self.modes
        return [mode.name for mode in modes]


# --- choice of pipelines (Algorithm 1, Steps 1 to 3)


def plan(args: LogArgs, modes: Sequence[Mode] | Bank) -> ModePlan:
    """Return the pipelines that run (Algorithm 1, Step 3)."""
    if isinstance(modes, Bank):
        return ModePlan(modes, None, f"of {args.imm} by their probability")
    if args.speed in (None, "auto"):
        rule, followed = RULES[args.follow]
        return ModePlan(modes, rule, f"by {followed} speed, up to or above {SLOW_MPS:g} m/s")
    speed = parse_speed(args.speed)
    mode = modes[int(mode_at(speed))]
    if speed > DESIGN_LIMIT_MPS:
        window = f"outside the design window (up to {DESIGN_LIMIT_MPS:g} m/s)"
        if args.outside == "abort":
            raise ValueError(f"speed: found {speed:g} m/s, {window}; --outside fallback runs on")
        warnings.warn(f"speed {speed:g} m/s is {window}; falling back to {mode.name}", stacklevel=2)
    side = "up to" if speed <= SLOW_MPS else "above"
    return ModePlan([mode], None, f"for {speed:g} m/s, {side} {SLOW_MPS:g} m/s")


def parse_speed(word: str) -> float:
    """Read a speed in m/s (Algorithm 1, Step 1).

    Raises:
        ValueError: the word is not a finite number, or is negative.
    """
    speed = number(word.strip())
    if not 0.0 <= speed < float("inf"):
        raise ValueError(f"speed: found {word.strip()!r}, expected a number of m/s, at least 0")
    return speed


# --- options


def inputs(args: LogArgs) -> Inputs:
    """Return the files of the log, its scene and the truth, if there is one."""
    if args.sample is None:
        if args.log is None:
            raise ValueError("log: found none, expected a measurement log, or --sample NAME")
        if args.log.is_dir():
            files = f"{args.log / LOG} --scene {args.log / SCENE} --truth {args.log / TRUTH}"
            raise ValueError(f"log: found the folder {args.log}, expected files, such as {files}")
        if args.scene is None:
            raise ValueError(f"scene: found none, expected --scene with that of {args.log}")
        return Inputs(args.log, args.scene, args.truth)
    _require_none("--sample", log=args.log, scene=args.scene)
    folder = sample_folder(args.sample)
    return Inputs(folder / LOG, str(folder / SCENE), args.truth or folder / TRUTH)


def _require_none(beside: str, **options: object) -> None:
    """Refuse options that mean nothing beside another one."""
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"{name}: found {value} with {beside}, expected one of them")


def _bank(args: LogArgs, name: str) -> Bank:
    """Return the bank of an IMM, by its name or from a mode file."""
    from_file = name.endswith(".json")
    bank = (
        bank_from(name, args.radio) if from_file else choose(imm_banks(args.radio), name, "imm")()
    )
    return replace(bank, modes=_as_asked(args, bank.modes))


def _modes(args: LogArgs) -> tuple[Mode, ...]:
    """Return the low-mobility and the high-mobility pipeline."""
    if args.modes is not None and args.modes.suffix != ".json":
        raise ValueError(f"modes: found {str(args.modes)!r}, expected a mode file (.json)")
    modes = modes_from(args.modes, args.radio)
    if len(modes) != 2:
        raise ValueError(
            f"{args.modes}: found {len(modes)} modes, expected 2, for low and for high mobility"
        )
    return _as_asked(args, modes)


def _as_asked(args: LogArgs, modes: tuple[Mode, ...]) -> tuple[Mode, ...]:
    """Return the modes with the safeguards that options ask for."""
    if args.robust:
        modes = tuple(map(robust, modes))
    if not args.gating:
        modes = tuple(replace(mode, gate=None) for mode in modes)
    if not args.adaptive:
        modes = tuple(replace(mode, adaptive=False) for mode in modes)
    return modes


def _check(args: LogArgs, files: Inputs) -> None:
    """Refuse options that contradict each other, and outputs that would replace other files."""
    if args.diagnose:
        if args.out or args.plot:
            raise ValueError("diagnose: found with --out or --plot, expected no track")
        if args.associate:
            raise ValueError("diagnose: found with --associate, expected rows with anchors")
    decided = args.speed in (None, "auto")
    if args.imm is not None:
        _require_none("--imm", speed=args.speed, modes=args.modes)
    if (args.imm or decided) and args.outside == "abort":
        other = "--imm" if args.imm else "--speed auto"
        raise ValueError(f"outside: found abort with {other}, expected a speed in m/s")
    if (args.imm or not decided) and args.follow == "odometry":
        raise ValueError("follow: found odometry without --speed auto, expected both")
    if not 2 <= args.window <= LONGEST_WINDOW:
        raise ValueError(
            f"window: found {args.window}, expected 2 to {LONGEST_WINDOW} epochs; --no-smoothing "
            "does without"
        )
    if args.height is not None and not np.isfinite(args.height):
        raise ValueError(f"height: found {args.height}, expected a number of meters")
    require_risk(args.risk)
    if args.plot is not None:
        require_picture("plot", args.plot)
    owners: dict[Path, str] = {}
    read = {"the log": files.log, "scene": Path(files.scene), "truth": files.truth}
    banks = {"modes": args.modes, "imm": Path(args.imm) if args.imm else None}
    for name, path in (read | banks | _outputs(args)).items():
        if path is not None and (owner := owners.setdefault(path.resolve(), name)) != name:
            raise ValueError(f"{name}: found {path}, which is also {owner}, expected another file")
    if args.out is not None:
        require_own_files(args.out)


def _outputs(args: LogArgs) -> dict[str, Path | None]:
    table = args.out and table_beside(args.out)
    return {"out": args.out, "the table beside out": table, "plot": args.plot, "json": args.json}


# --- running


class Work(NamedTuple):
    """A log to localize, and the modes to localize it with."""

    scene: Scene
    radio: Radio
    plan: ModePlan
    first: LogBlock  # first block of the log
    blocks: Iterable[LogBlock]  # all blocks, the first included
    truth: Truth | None
    association: Association | None  # counts of associated paths so far


def _work(args: LogArgs, files: Inputs, scene: Scene, epochs_per_block: int) -> Work:
    """Open the log, and the truth if there is one."""
    modes = _modes(args) if args.imm is None else _bank(args, args.imm)
    association, radio = None, radio_from(args.radio)
    if args.associate:
        association = Association(len(scene.anchors_m))
        paths = read_paths(files.log, scene, args.odometry)
        fast = modes_from(args.modes, args.radio)[-1]
        blocks = associate(paths, scene, radio, fast, association, epochs_per_block)
    else:
        blocks = read_log(files.log, scene, epochs_per_block, args.odometry)
    first = next(blocks)
    if args.follow == "odometry" and not first.layout.odometry:
        raise ValueError(
            f"follow: found odometry, but no speed in {files.log}, expected prediction"
        )
    truth, blocks = Truth(files.truth) if files.truth else None, chain([first], blocks)
    return Work(scene, radio, plan(args, modes), first, blocks, truth, association)


def _track(args: LogArgs, work: Work, window: int | None) -> Iterator[TrackBlock]:
    modes, rule, _ = work.plan
    return localize(work.blocks, work.scene, work.radio, modes, rule, window, args.height)


def beginning(args: LogArgs, epochs: int) -> tuple[TrackBlock, Work]:
    """Filter the first epochs of a log; return their track and the work.

    Raises:
        ValueError: same as from the command.
        OSError: a file can't be read.
    """
    files = inputs(args)
    work = _work(args, files, scene_from(files.scene), epochs)
    return next(_track(args, work, None)), work


def _run(args: LogArgs, work: Work) -> tuple[dict[str, Any], TrackSampler, ValueError | None]:
    """Localize, score and write, block by block.

    Returns:
        Figures, the track to draw, and the error of the log or the truth, if there is one.

    Raises:
        LogError: the log is damaged before the first epoch of a track; nothing is written.
    """
    names, truth = work.plan.names, work.truth
    course, groups, sampler = Course(names), Groups(), TrackSampler(names, work.scene.anchors_m)
    tracks = ["filtered", "smoothed"] if args.smoothing else ["filtered"]
    scores = TruthScores(truth, tracks, args.height is not None, args.risk) if truth else None
    first: list[LogBlock] = []
    if truth:
        work = work._replace(blocks=keeping(work.blocks, first))
    track = _track(args, work, args.window if args.smoothing else None)
    error: ValueError | None = None
    with ExitStack() as stack:
        write = stack.enter_context(track_files(args.out, names)) if args.out else None
        report = stack.enter_context(progress("localizing"))
        try:
            for block in track:
                sampler.add(block, scores.add(block) if scores else None)
                course.add(block)
                groups.add(block)
                if write:
                    write(block)
                report(block.share)
        except LogError as damage:
            if not course.epochs:
                raise
            error = damage
    figures = {**course.figures(), "groups": groups.figures()}
    if work.association:
        figures["association"] = work.association.figures()
    if truth and scores and scores.scored:
        truth.warn_if_few(scores.scored, course.epochs, course.first_s, course.last_s)
        first_epochs = first[0].joined(first)
        clock = clock_offset(first_epochs, work.scene, lambda time_s: Truth(truth.path).at(time_s))
        figures["truth"] = scores.figures() | {"clock": clock and clock.figures()}
        if clock and clock.matters:
            warnings.warn(f"{truth.path}: {clock.advice}", stacklevel=2)
        scores.warn_if_far("filtered")
    elif truth and not error:
        error = truth.no_match(course.first_s, course.last_s)
    return figures, sampler, error


def localized(args: LogArgs) -> None:
    """Run the command."""
    files = inputs(args)
    _check(args, files)
    scene = scene_from(files.scene)
    if args.diagnose:
        return diagnosed(args, files.log, scene, files.truth, _modes(args)[-1])
    work = _work(args, files, scene, EPOCHS_PER_BLOCK)
    outputs = _outputs(args)
    for path in filter(None, outputs.values()):
        require_writable(path)
    figures, sampler, error = _run(args, work)
    doubts = contradictions(work.first, scene, work.radio, figures["groups"])
    for doubt in doubts:
        warnings.warn(f"{doubt}; --diagnose tries likely mistakes", stacklevel=2)
    kind = "smoothed" if args.smoothing else "filtered"
    written = {
        f"{kind} track": outputs["out"],
        "its standard deviations and modes": outputs["the table beside out"],
        "picture": outputs["plot"],
    }
    figures = {
        "log": str(files.log),
        "scene": scene.name,
        "radio": args.radio,
        "imm": args.imm,
        "rule": work.plan.why,
        **figures,
        "contradictions": [d._asdict() for d in doubts],
        "written": {content: str(path) for content, path in written.items() if path},
        "error": error and str(error),
    }
    if args.json:  # first, because whoever reads the tables may close the pipe
        write_json(args.json, provenance("localize", args) | figures)
    try:
        if args.plot:
            log = "/".join(files.log.parts[-2:])
            draw_trajectory(sampler.track, args.plot, f"{log}, {kind} track")
    finally:  # the figures are shown even if a picture fails
        try:
            show(track_markdown(figures))
        finally:  # and the error of the log is reported even if nobody reads the figures
            if error:
                shown = "written" if args.out else "shown"
                raise ValueError(f"{error}; {figures['epochs']} epochs are {shown}") from error
