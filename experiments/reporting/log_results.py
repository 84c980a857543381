"""The ``localize`` command for a recorded log: options, track, scores, files, printed results.

With ``--diagnose``, it reports facts about the log, and its likely mistakes.
"""

import warnings
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.console.options import (
    AUTO,
    LogArgs,
    require_alone,
    require_at_least,
    require_default,
)
from experiments.console.output import progress, show
from experiments.console.provenance import provenance
from experiments.reporting.figures import draw_trajectory, require_picture
from experiments.reporting.log_choice import (
    choice_of,
    is_algorithm_1,
    modes_of,
    radio_of,
    require_one_choice,
    scene_of,
)
from experiments.reporting.log_report import (
    UNSEEN,
    diagnosis_markdown,
    facts_markdown,
    log_facts,
    track_markdown,
    verdict,
)
from mmwave_env.datasets.log_folder import LOG, SCENE, STATION, TRUTH
from mmwave_env.datasets.samples import sample_folder
from mmwave_env.filters.bank import modes_from
from mmwave_env.interface.policy import Switching
from mmwave_env.io.files import Json, require_writable, write_json
from mmwave_env.io.lookup import as_name
from mmwave_env.localization.association import MOST_FALSE, MOST_MISSED, associate
from mmwave_env.localization.contradictions import Contradiction, contradictions
from mmwave_env.localization.diagnosis import diagnose
from mmwave_env.localization.first_position import across, on_a_line
from mmwave_env.localization.levels import Levels
from mmwave_env.localization.localizer import Track, localize
from mmwave_env.localization.log_noise import nearest_radio, noise_notes, with_range_steps
from mmwave_env.localization.map_files import MAP_FILES, origin_of
from mmwave_env.localization.map_learning import FEW_EXPLAINED, learn_map
from mmwave_env.localization.readings import AS_IT_IS, Finding, Reading
from mmwave_env.localization.shared_errors import scanned, shared_errors
from mmwave_env.localization.track_files import require_own_files, table_beside, write_track
from mmwave_env.localization.track_scores import (
    group_statistics,
    track_statistics,
    truth_scores,
    warn_if_far,
)
from mmwave_env.logs.log import Log, read_log, read_paths
from mmwave_env.logs.truth import Truth
from mmwave_env.models.layout import require_clock
from mmwave_env.models.radio import TUNED_RADIOS, Radio
from mmwave_env.models.scene import Scene, scene_json
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import NEUTRAL_SNR_DB
from policies.corrector import TWO_WAY, TwoWayCorrector


def _diagnosed_first(readings: Sequence[Reading]) -> tuple[Reading, list[Finding]]:
    """Return the first reading that becomes consistent, or the first one, with its findings."""
    tried = []
    for reading in readings:
        findings = diagnose(reading)
        if not findings[0].contradictions:
            return reading, findings
        tried.append(findings)
    return readings[0], tried[0]


def diagnosed(args: LogArgs, files: "Inputs", scene: Scene) -> None:
    """Show facts about a log, and whether undoing a likely mistake makes the log consistent.

    If its first epochs are consistent as they are, what contradicts its whole track counts, too.

    Raises:
        LogError: the log is damaged.
        ValueError: no epoch determines a position with which a track could begin.
    """
    log = read_log(
        files.log, scene, odometry=False, limits=False, snr_db=args.snr, clock=args.clock
    )
    if args.clock != "free" and "snr_db" in log.columns:
        whole = log.whole()
        if whole.visible[:, 0].any():  # with some columns, links are always incomplete
            log = whole
    names = [args.radio]
    if args.radio == AUTO:  # wrong values may be nearest to another radio
        names = [*dict.fromkeys([nearest_radio(log, scene), *TUNED_RADIOS])]
    with progress("looking for likely mistakes"):
        log, step_m = with_range_steps(log, scene, radio_of(args, names[0]))
        readings = [
            Reading(log, scene, radio_of(args, name), modes_of(args, name)[-1]) for name in names
        ]
        reading, findings = _diagnosed_first(readings)
        best, lost = _confirmed(args, files, scene, findings)
        facts = log_facts(log, scene)
        cured = best.cure and (best.shared or not best.contradictions)
        # a wrong convention looks like noise of angles, or a clock that jumps
        notes = (
            []
            if (cured and best.misread) or lost
            else list(noise_notes(reading, step_m, args.correlation))
        )
    corrected = best.scene if cured and best.scene is not scene else None
    text = f"{facts_markdown(facts)}\n{diagnosis_markdown(findings, notes)}"
    if args.write and corrected:
        write_json(args.write, scene_json(corrected))
        text += f"\nWritten: {args.write} (corrected scene)\n"
    elif args.write:
        why = "no correction is known" if best.contradictions else "nothing is wrong"
        why = "correct the log, not the scene" if cured else why
        text += f"\nNot written: {why}.\n"
    if args.json:
        figures = {
            "facts": facts,
            "verdict": verdict(findings),
            "notes": notes,
            "hypotheses": [_hypothesis(finding, scene) for finding in findings],
        }
        write_json(args.json, provenance("localize", args) | figures)
    show(text)
    if log.damage:
        raise log.damage


def _confirmed(
    args: LogArgs, files: "Inputs", scene: Scene, findings: list[Finding]
) -> tuple[Finding, bool]:
    """Judge the log as it is by its whole track; move it to the front if it is the best finding.

    Return the best finding, and whether tracks are lost without the gates that this track has: then
    the findings say little.
    """
    best = findings[0]
    as_it_is = next(finding for finding in findings if finding.hypothesis == AS_IT_IS)
    fits = best is as_it_is and not best.contradictions
    if best is as_it_is or best.misread:
        with suppress(ValueError):  # values may be too wrong for a track
            work = _work(args, files, scene)
            _, doubts = _consistency(args, work, _track(args, work))
            if fits or not doubts:
                findings.remove(as_it_is)
                findings.insert(0, as_it_is._replace(contradictions=doubts))
    return findings[0], not fits and findings[0] is not best


def _hypothesis(finding: Finding, scene: Scene) -> Json:
    """Return a finding as JSON, with its scene if this is not the log's."""
    return {
        **finding._asdict(),
        "contradictions": [c._asdict() for c in finding.contradictions],
        "scene": None if finding.scene is scene else scene_json(finding.scene),
    }


_ONE_HEIGHT_M = 1.0  # if heights differ by less, ranges hardly tell what is above the anchors
_UNCERTAIN_HEIGHT_M = 2.0  # with this deviation, heights of other anchors do not tell it, either
LONGEST_WINDOW = 20_000  # maximum length of the smoother's window, epochs; limits its memory


class Inputs(NamedTuple):
    """Files to read, from the command line or from a sample."""

    log: Path
    scene: str
    truth: Path | None
    earlier: Sequence[Path] = ()  # logs from which a map is learned before


def inputs(args: LogArgs) -> Inputs:
    """Return the files of the log, of its scene and of the ground truth, if there is one."""
    if args.sample is None:
        if args.log is None:
            raise ValueError("log: found none, expected a log as first argument, or --sample NAME")
        if args.log.is_dir():
            raise ValueError(f"log: found the folder {args.log}, expected {args.log / LOG}")
        if args.scene is None:
            raise ValueError(f"scene: found none, expected --scene FILE, the scene of {args.log}")
        *earlier, log = [args.log, *args.more]
        return Inputs(log, args.scene, args.truth, earlier)
    require_alone(args, "sample", "log", "scene")
    folder = sample_folder(args.sample)
    station = folder / STATION
    scene = station if args.map == "learn" and station.exists() else folder / SCENE
    return Inputs(folder / LOG, str(scene), args.truth or folder / TRUTH)


def check_options(args: LogArgs, files: Inputs) -> None:
    """Refuse options that contradict each other, and outputs that would replace other files."""
    require_clock(args.clock)
    require_alone(args, "diagnose", "out", "plot", "truth", "associate")
    if not args.diagnose:
        require_default(args, "--diagnose", "write")
    require_alone(args, "associate", "clock")
    require_alone(args, "map", "diagnose", "clock")
    if args.map == "known":
        require_default(args, "--map learn", "map_out")
        if args.more:
            raise ValueError(
                f"log: found {1 + len(args.more)} logs without --map learn, expected one"
            )
    require_alone(args, "two_way", "height", "smoothing", "correlation")
    require_one_choice(args)
    require_at_least(0, args, "correlation")
    if not 2 <= args.window <= LONGEST_WINDOW:
        raise ValueError(
            f"window: found {args.window}, expected 2 to {LONGEST_WINDOW} epochs; --no-smoothing "
            "turns smoothing off"
        )
    if args.height is not None and not np.isfinite(args.height):
        raise ValueError(f"height: found {args.height}, expected a number of meters")
    Levels(args.risk, args.levels)  # raises if the risk or the kind is invalid
    if args.plot is not None:
        require_picture("plot", args.plot)
    read = [*files.earlier, files.log, files.scene, files.truth]
    taken = {Path(file).resolve() for file in read if file}
    for option, path, _ in _outputs(args):
        if path.resolve() in taken:
            raise ValueError(f"{option}: found {path}, expected a file with no other role")
        taken.add(path.resolve())
    for out in args.out:
        require_own_files(out)


def _outputs(args: LogArgs) -> list[tuple[str, Path, str]]:
    """Return the option, the path and the content of every file to write."""
    tables = dict.fromkeys(table for table in map(table_beside, args.out) if table not in args.out)
    files = [
        *(("out", out, f"{_kind(args)} track") for out in args.out),
        *(
            ("the table that --out also writes", t, "table of standard deviations and modes")
            for t in tables
        ),
        ("plot", args.plot, "picture"),
        ("map-out", args.map_out, "scene with the learned images"),
        ("json", args.json, ""),
        ("write", args.write, ""),
    ]
    return [(option, path, content) for option, path, content in files if path]


class Work(NamedTuple):
    """A log to localize, and the modes to localize it with."""

    scene: Scene
    profile: str  # name or file of the radio profile
    radio: Radio
    switching: Switching
    why: str  # words after "modes" in the report
    log: Log
    truth: Truth | None
    association: Json | None  # counts of associated paths
    range_step_m: float | None  # step in which ranges come; their noise contains it
    map: Json | None  # learned images, and counts of paths they explain

    def truth_m(self, time_s: Array) -> Array:
        """Return true positions (n, 3), m, at some times; NaN where they are not known."""
        return self.truth.at(time_s) if self.truth else np.full((len(time_s), 3), np.nan)


def _work(args: LogArgs, files: Inputs, scene: Scene) -> Work:
    """Read the log and, if there is one, the ground truth; choose the modes."""
    association = None
    learned = None
    if args.associate or args.map == "learn":
        name = "handset" if args.radio == AUTO else args.radio
        radio = radio_of(args, name)
        fast = modes_from(args.modes, name)[-1]
        if args.map == "learn":
            logs = [
                read_paths(path, scene, args.odometry, args.snr)
                for path in (*files.earlier, files.log)
            ]
            scene, learned = learn_map(logs, scene, radio, fast)
            warn_of_few_explained(learned["explained"], learned["paths"])
        paths = read_paths(files.log, scene, args.odometry, args.snr)
        log, association = associate(paths, scene, radio, fast)
        warn_of_poor_association(association)
    else:
        log = read_log(
            files.log, scene, args.odometry, snr_db=args.snr, clock=args.clock,
        )  # fmt: skip
        name = nearest_radio(log, scene) if args.radio == AUTO else args.radio
        radio = radio_of(args, name)
    if args.follow == "odometry" and not log.layout.odometry:
        raise ValueError(
            f"follow: odometry needs speeds, and {files.log} has none; use --follow prediction"
        )
    elevations = bool(np.isfinite(log.links[..., 2]).any())
    switching, why = choice_of(args, name, elevations)
    if switching.policy and not np.isfinite(log.snr_db).any():
        warnings.warn(
            f"{files.log}: found no SNR, so the policy gets {NEUTRAL_SNR_DB:g} dB for every link",
            stacklevel=2,
        )
    truth = Truth(files.truth) if files.truth else None
    log, step_m = with_range_steps(log, scene, radio)
    return Work(scene, name, radio, switching, why, log, truth, association, step_m, learned)


def warn_of_few_explained(explained: int, paths: int) -> None:
    """Warn if a learned map explains few paths."""
    if explained < FEW_EXPLAINED * paths:
        warnings.warn(
            f"map: found {explained} of {paths} paths that come from the base station or a learned "
            f"image, expected {FEW_EXPLAINED:.0%} or more. Other things than flat walls reflect "
            "here, as usual indoors, so do not trust the map or the track",
            stacklevel=3,
        )


def warn_of_poor_association(association: Json) -> None:
    """Warn if many paths belong to no anchor, and an anchor lacks a path in many epochs."""
    paths = association["paths"]
    false = association["false"]
    missed = association["missed"]
    rarest = max(missed, key=lambda name: missed[name])
    epochs = missed[rarest] + association["associated"][rarest]
    if false > MOST_FALSE * paths and missed[rarest] > MOST_MISSED * epochs:
        warnings.warn(
            f"paths: found {false} of {paths} that belong to no anchor, and {rarest} without a "
            f"path in {missed[rarest]} of {epochs} epochs, expected less than {MOST_FALSE:.0%} or "
            f"{MOST_MISSED:.0%}. The map, the frame of the angles or the receiver's clock may be "
            "off, so do not trust the track",
            stacklevel=3,
        )


def _track(args: LogArgs, work: Work, window: int | None = None, **more: Any) -> Track:
    if args.two_way and not work.switching.bank:
        raise ValueError("two-way: found modes with a shared belief, expected an IMM (--imm)")
    return localize(
        work.log,
        work.scene,
        work.radio,
        work.switching,
        window,
        args.height,
        Levels(args.risk, args.levels),
        TwoWayCorrector(TWO_WAY) if args.two_way else None,
        correlation_s=args.correlation,
        **more,
    )


def _consistency(args: LogArgs, work: Work, track: Track) -> tuple[Json, list[Contradiction]]:
    """Return statistics of a track's measurements, and what contradicts the scene or the radio."""
    groups = group_statistics(track, track.accepted, track.nis)
    # with --correlation, the filter adds noise, so that a small NIS is no mistake
    doubts = contradictions(
        work.log, work.scene, work.radio, groups, track.x[:, 2], small_nis=not args.correlation
    )
    return groups, doubts


def _shared_errors(work: Work) -> dict[str, str]:
    """Return the most likely error that all links of a log share, with advice; {} if none."""
    advice = {}
    with suppress(ValueError):  # measurements may be too wrong for a filter without gates
        reading = Reading(work.log, work.scene, work.radio, modes_from(None, work.profile)[-1])
        for error in shared_errors(scanned(reading), rounds=1):
            change = error.change(reading)
            if work.map:
                advice[str(error)] = "a frame or a clock that is off distorts a learned map, too"
            elif work.association and change:
                advice[str(error)] = f"to correct it, {change}"
            else:
                advice[str(error)] = "--diagnose says how to correct it"
    return advice


def _may_be_mirrored(track: Track, scene: Scene) -> bool:
    """Tell whether a track without elevations may be on the wrong side of its anchors.

    Anchors of one height have a side above and one below. So do a few anchors if the height is
    uncertain. Around anchors on a line, any turn of the track leaves the ranges as they are.
    """
    heights = scene.anchors_m[:, 2]
    measured = np.isfinite(track.links)
    if measured[..., 2].any():
        return False
    if on_a_line(scene.anchors_m) and not measured[..., [1, 3]].any():
        return True
    deviation = np.sqrt(track.P[:, 5])
    if np.median(deviation) > _UNCERTAIN_HEIGHT_M:
        return True
    spread = np.ptp(heights)
    near = abs(track.x[:, 2] - heights.mean()) < 2.0 * deviation + spread
    doubtful = near.mean() > 0.15 or scene.streets.height_m > heights[0]
    return bool(spread < _ONE_HEIGHT_M and doubtful)


def _may_change_sides(track: Track, scene: Scene) -> bool:
    """Tell whether ranges alone can't say on which side of its anchors, on a line, a track goes on.

    It may be on either side once it is within three standard deviations of the line.
    """
    measured = np.isfinite(track.links)
    anchors = scene.anchors_m[measured.any(axis=(0, 2)), :2]
    if measured[..., [1, 3]].any() or not on_a_line(anchors):
        return False
    dx, dy = anchors[-1] - anchors[0]
    variance = track.P[:, :3] @ [dy**2, -2.0 * dx * dy, dx**2]
    return bool((across(anchors, track.x) ** 2 < 9.0 * variance).any())


def beginning(args: LogArgs, epochs: int) -> tuple[Track, Work]:
    """Filter the first epochs of a log; return their track and the log's :class:`Work`."""
    files = inputs(args)
    work = _work(args, files, scene_of(args, files.scene))
    work = work._replace(log=work.log.part(slice(epochs)))
    return _track(args, work).by_segment()[0], work


def _figures(args: LogArgs, files: Inputs, work: Work, track: Track) -> Json:
    """Return all results about a track, and an error in the log or in the ground truth, if any."""
    scores: Json = {"error": None}
    truth = work.truth
    if truth:
        names = ["filtered", "smoothed"] if args.smoothing else ["filtered"]
        try:
            accuracy = truth_scores(track, truth, names, args.risk)
        except ValueError as error:
            scores["error"] = str(error)
        else:
            warn_if_far(truth, accuracy)
            scores["truth"] = accuracy | {"levels": args.levels}
    if track.damage:
        scores["error"] = str(track.damage)
    groups, doubts = _consistency(args, work, track)
    odd = [f"{doubt}; --diagnose looks for a likely mistake" for doubt in doubts]
    errors = _shared_errors(work)
    odd += [f"the log looks as if {e}; {UNSEEN}; {advice}" for e, advice in errors.items()]
    if args.height is None and _may_be_mirrored(track, work.scene):
        odd.append(
            "heights: without elevations, few anchors, anchors of one height, or ranges of anchors "
            "on a line do not say how high the user is; if the ground is flat, add --height"
        )
    if _may_change_sides(track, work.scene):
        odd.append(
            "side: ranges of anchors on a line do not say on which side the user is, and the track "
            "comes near this line; from there on, it may be mirrored. Azimuths, or an anchor off "
            "the line, tell the sides apart"
        )
    for message in odd:
        warnings.warn(message, stacklevel=2)
    more = {"association": work.association, "map": work.map}
    return {
        "log": str(files.log),
        "scene": work.scene.name,
        "radio": work.profile + (", chosen by auto" if args.radio == AUTO else ""),
        "rule": work.why,
        "range_step_m": work.range_step_m,
        "algorithm_1": is_algorithm_1(args),
        **track_statistics(track),
        "groups": groups,
        **{name: figures for name, figures in more.items() if figures},
        **scores,
        "contradictions": [d._asdict() for d in doubts],
        "shared_errors": [*errors],
        "written": {str(path): content for _, path, content in _outputs(args) if content},
    }


def _kind(args: LogArgs) -> str:
    return "smoothed" if args.smoothing else "filtered"


def localized(args: LogArgs) -> None:
    """Run ``mmwave-loc localize`` on a recorded log."""
    files = inputs(args)
    check_options(args, files)
    require_default(args, "--live", "format", "accuracy", "confidence")
    scene = scene_of(args, files.scene)
    if args.diagnose:
        diagnosed(args, files, scene)
        return
    for out in args.out:
        if out.suffix in MAP_FILES:
            origin_of(scene, f"out: {out}")
    for _, path, _ in _outputs(args):
        require_writable(path)
    work = _work(args, files, scene)
    with progress("localizing") as report:
        track = _track(args, work, args.window if args.smoothing else None, report=report)
    name = as_name(Path(files.log.name.removesuffix(".gz")).stem)
    write_track(track, args.out, scene, name, args.risk)
    if args.map_out:
        write_json(args.map_out, scene_json(work.scene))
    figures = _figures(args, files, work, track)
    if args.json:  # before show(), which fails if the reader of the tables closes the pipe
        write_json(args.json, provenance("localize", args) | figures)
    try:
        show(track_markdown(figures))  # also if a picture fails
        if args.plot:
            title = f"{'/'.join(files.log.parts[-2:])}, {_kind(args)} track"
            learned = work.map["images"] if work.map else []
            draw_trajectory(
                track, work.truth_m(track.time_s), work.scene, args.plot, title, learned
            )
    finally:  # an error in the log is reported even if the results can't be shown
        if figures["error"]:
            shown = "written" if args.out else "shown"
            raise ValueError(f"{figures['error']}; {figures['epochs']} epochs are {shown}")
