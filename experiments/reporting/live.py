"""Live localization: rows from standard input, one JSON line per epoch on standard output."""

import gc
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, tee
from typing import Any

import numpy as np

from experiments.console.options import AUTO, LogArgs, require_alone, require_default
from experiments.console.output import note
from experiments.reporting.log_choice import choice_of, radio_of, scene_of
from experiments.reporting.log_results import check_options, inputs, warn_of_few_explained
from mmwave_env.filters.bank import modes_from
from mmwave_env.io.files import Json, first_line, parse_json, write_json
from mmwave_env.io.lookup import printable, quoted
from mmwave_env.localization.contradictions import Contradiction, contradictions
from mmwave_env.localization.image_filter import Belief, Paths
from mmwave_env.localization.levels import Levels
from mmwave_env.localization.location_data import location_data
from mmwave_env.localization.log_noise import nearest_radio
from mmwave_env.localization.map_files import geodetic, origin_of
from mmwave_env.localization.map_learning import (
    MapLearner,
    learned_scene,
    require_same_images,
    trusted,
)
from mmwave_env.localization.track_scores import group_statistics
from mmwave_env.localization.tracker import Position, Tracker
from mmwave_env.logs.live_log import LiveEpoch, LiveLog, log_from
from mmwave_env.logs.log_tables import LogError, header_of
from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Origin, Scene, scene_json

SOURCE = "standard input"
Lines = Iterator[tuple[int, str] | None]  # numbers and texts; None where the input waits
_ENOUGH_PATHS = 400  # paths after which a warning says if a learned map explains few of them
_ENOUGH_POSITIONS = 100  # after which warnings say what contradicts the first track
_PATIENCE_S = 10.0  # time without a first position after which a warning says so


def run_live(args: LogArgs) -> None:
    """Read rows until the end of the input; print the estimated position after each epoch.

    A damaged or late row causes a warning and is left out.

    Raises:
        ValueError: options contradict each other, or line 1 is neither a header nor JSON.
    """
    if str(args.log) != "-" or args.scene is None:
        raise ValueError('live: needs "-" (standard input) as the log, and --scene')
    if args.associate:
        raise ValueError("associate: found --live, for which --map learn assigns paths to anchors")
    require_alone(
        args, "live", "sample", "truth", "out", "plot", "json", "two_way", "diagnose", "odometry",
        "more", "write", "window", "smoothing",
    )  # fmt: skip
    check_options(args, inputs(args))
    scene = scene_of(args, args.scene)
    origin = _origin(args, scene)
    if args.map == "learn":
        _run_map(args, scene, origin)
        return
    tracker: Tracker | None = None
    began = False
    waiting: list[LiveEpoch] = []  # epochs before the first position
    waited = False
    to_judge: _FirstEpochs | None = _FirstEpochs()
    for live, epochs in _epochs(args, scene):
        if tracker is None:
            linked = (epoch for epoch in epochs if log_from([epoch]).visible_links.any())
            first = next(linked, None)
            if first:
                tracker, why = _tracker(args, scene, first)
        placed = []
        for user, position in tracker.step(epochs) if tracker else ():
            if not began or (position.begins and not user):
                note(f"a track begins, or begins anew, at {position.time_s!r} s: {why}")
            content: Json = {"ue": user} if user else {}
            content |= _formatted(args, position, origin)
            print(json.dumps(content), flush=not user)
            began = True
            placed.append((user, position))
        sys.stdout.flush()
        if tracker:
            live.forget(tracker.forgotten)
            if to_judge and to_judge.add(epochs, placed):
                for doubt in to_judge.contradictions(scene, tracker.radio):
                    _warn(f"{SOURCE}: {doubt}; for a file of these rows, --diagnose looks for why")
                to_judge = None
        waited = waited or began or _waited_long(waiting, epochs)
    if not began:
        _warn(f"{SOURCE}: found no epoch that determines a position")


def _run_map(args: LogArgs, scene: Scene, origin: Origin | None) -> None:
    """Learn the map from rows that are paths; print the position after each epoch with a track.

    A doubtful epoch waits for the next ones. If the map explains few paths, a warning says so. At
    the end, also after a signal, the map is written if --map-out asks for it.
    """
    require_alone(
        args, "map", "policy", "imm", "speed", "height", "levels", "risk", "correlation", "robust",
        "follow",
    )  # fmt: skip
    name = "handset" if args.radio == AUTO else args.radio
    mode = modes_from(args.modes, name)[-1]
    learner = MapLearner(scene, radio_of(args, name), mode)
    latest: Belief | None = None  # with a track
    paths = 0
    explained = 0
    judged = False
    ours, theirs = tee(_paths(args, scene, learner))
    try:
        for of_epoch, belief in zip(ours, learner.follow(theirs), strict=True):
            paths += len(of_epoch)
            explained += len(belief.labels)
            if paths >= _ENOUGH_PATHS and not judged:
                warn_of_few_explained(explained, paths)
                judged = True
            if belief.tracked:
                latest = belief
                images = {"images": sum(map(trusted, belief.images))}
                position = _of_map(belief, mode.name, origin)
                print(json.dumps(_formatted(args, position, origin) | images), flush=True)
    finally:
        if args.map_out and latest:
            learned = learned_scene(scene, latest)
            require_same_images(scene, learned)
            write_json(args.map_out, scene_json(learned))
    if latest is None:
        _warn(f"{SOURCE}: found no path with which a track can begin, so there is no map")


def _of_map(belief: Belief, mode: str, origin: Origin | None) -> Position:
    """Return the position in a belief about the user and the map."""
    x = belief.x
    return Position(
        time_s=belief.time_s,
        position_m=x[:3].tolist(),
        covariance_m2=belief.P[:3, :3].tolist(),
        velocity_mps=x[3:6].tolist(),
        mode=mode,
        nis={},
        rejected=[],
        begins=belief.begins,
        geodetic=geodetic(origin, x[None, :3])[0].tolist() if origin else None,
    )


def _paths(args: LogArgs, scene: Scene, learner: MapLearner) -> Iterator[Paths]:
    """Yield the paths of each epoch of standard input."""
    for _, epochs in _epochs(args, scene, associated=False):
        if any(epoch.user for epoch in epochs):
            raise ValueError("map: found rows with users (ue), expected the paths of one user")
        for epoch in epochs:
            yield from learner.observed(epoch.paths())


def _formatted(args: LogArgs, position: Position, origin: Origin | None) -> Json:
    """Return the content of an output line, without unknown values, as --format asks for it."""
    if origin:
        return location_data(position, origin, args.confidence, args.accuracy)
    return {name: value for name, value in position._asdict().items() if value is not None}


def _waited_long(waiting: list[LiveEpoch], epochs: Sequence[LiveEpoch]) -> bool:
    """Add epochs to those without a position; if these last too long, warn what they measured."""
    waiting += epochs
    if not waiting or waiting[-1].time_s - waiting[0].time_s <= _PATIENCE_S:
        return False
    groups = set()
    for log in (log_from([epoch]) for epoch in waiting):
        names = zip(log.layout.group_names, log.visible[0], strict=True)
        groups |= {name for name, visible in names if visible}
    _warn(
        f"{SOURCE}: found no position in {_PATIENCE_S:g} s, only the columns "
        f"{', '.join(sorted(log.columns))} of "
        f"{', '.join(sorted(groups)) or 'no anchor'}; docs/data.md says what a track needs"
    )
    return True


class _FirstEpochs:
    """The first epochs with positions of a user, all of one layout, to be compared with these."""

    def __init__(self) -> None:
        self._placed: list[tuple[LiveEpoch, Position]] = []

    def add(self, epochs: Sequence[LiveEpoch], placed: Sequence[tuple[str, Position]]) -> bool:
        """Add epochs, and users with positions in them; return whether that is enough to judge."""
        by_time = {(epoch.user, epoch.time_s): epoch for epoch in epochs}
        for user, position in placed:
            epoch = by_time[user, position.time_s]
            first, _ = self._placed[0] if self._placed else (epoch, position)
            if epoch.layout != first.layout:  # all tracks have begun anew
                self._placed.clear()
            if user == first.user:
                self._placed.append((epoch, position))
        return len(self._placed) >= _ENOUGH_POSITIONS

    def contradictions(self, scene: Scene, radio: Radio) -> list[Contradiction]:
        """Return what in the epochs contradicts the positions, the scene or the radio."""
        epochs, positions = zip(*self._placed, strict=True)
        log = log_from(epochs)
        names = log.layout.group_names
        nis = np.array([[p.nis.get(name, np.nan) for name in names] for p in positions])
        rejected = np.array([[name in p.rejected for name in names] for p in positions])
        filtered = replace(log, visible=np.isfinite(nis))
        groups = group_statistics(filtered, filtered.visible & ~rejected, np.nan_to_num(nis))
        heights_m = [p.position_m[2] for p in positions]
        # the first epoch chose the radio, perhaps one with more noise; that does no harm
        return contradictions(log, scene, radio, groups, heights_m, small_nis=False)


def _tracker(args: LogArgs, scene: Scene, first: LiveEpoch) -> tuple[Tracker, str]:
    """Return a tracker for a log with this first epoch, and its modes and radio in words."""
    radio = nearest_radio(log_from([first]), scene) if args.radio == AUTO else args.radio
    switching, why = choice_of(args, radio, "aoa_elevation" in first.columns.file.columns)
    tracker = Tracker(
        scene, switching, radio_of(args, radio), height_m=args.height,
        levels=Levels(args.risk, args.levels), correlation_s=args.correlation,
    )  # fmt: skip
    gc.freeze()  # else Python's garbage collector stops the rows for 70 ms at times
    return tracker, f"modes {why}, radio {radio}"


def _origin(args: LogArgs, scene: Scene) -> Origin | None:
    """Return the scene's origin if --format needs it."""
    if args.format == "lines":
        require_default(args, "--format 3gpp", "accuracy", "confidence")
        return None
    if not 0.0 < args.confidence < 1.0:
        raise ValueError(f"confidence: found {args.confidence}, expected between 0 and 1")
    if args.accuracy is not None and not args.accuracy > 0.0:
        raise ValueError(f"accuracy: found {args.accuracy}, expected meters above 0")
    return origin_of(scene, "format: 3gpp")


def _lines() -> Lines:
    """Yield the numbers and texts of the lines of standard input; None where the input waits."""
    stream: Any = sys.stdin.buffer
    number = 1
    rest = b""
    while piece := stream.read1(1 << 16):
        *lines, rest = (rest + piece).split(b"\n")
        yield from enumerate(map(_text, lines), start=number)
        yield None
        number += len(lines)
    if rest:
        yield number, _text(rest)
        yield None


def _text(line: bytes) -> str:
    """Return a line as text; bytes that are no text become escape codes, which checks refuse."""
    return line.decode(errors="backslashreplace").removeprefix("\ufeff").rstrip()


def _epochs(
    args: LogArgs, scene: Scene, associated: bool = True
) -> Iterator[tuple[LiveLog, list[LiveEpoch]]]:
    """Read rows (CSV below a header, or JSON objects); yield the epochs that they form.

    A JSON object is one row, or a whole epoch: {"rows": [...]}. Epochs that arrive together are
    yielded together, with the log to which they belong.
    """
    lines: Lines = (line for line in _lines() if line is None or line[1])
    number, first = next(filter(None, lines), (0, ""))
    if not first:
        raise ValueError(f"log: found nothing on {SOURCE}, expected a header or JSON lines")
    as_json = first.lstrip().startswith("{")
    names: list[str] = []
    delimiter = ""
    if as_json:
        _objects(first, number)  # refused here if it is damaged
        lines = chain([(number, first)], lines)
    else:
        names, delimiter = header_of(first, f"{SOURCE}, line {number}")
    log = LiveLog(names, scene, args.snr, SOURCE, args.clock, delimiter, associated)
    epochs: list[LiveEpoch] = []
    for line in lines:
        if line is None:
            yield log, epochs
            epochs = []
        else:
            epochs += _added(log, *line, as_json)
    yield log, log.end_epoch()
    if log.left_out:
        counts = ", ".join(f"{name}: {count}" for name, count in log.left_out.items())
        _warn(f"{SOURCE}: left out in all: {counts}")


def _added(log: LiveLog, number: int, line: str, as_json: bool) -> Iterator[LiveEpoch]:
    """Add a line to a log; yield the epochs that are now over. Warn of what is left out."""
    try:
        rows, whole = _objects(line, number) if as_json else ([line], False)
    except LogError as error:
        _warn(error)
        return
    for row in rows:
        try:
            yield from log.add(row, number)
        except LogError as error:
            _warn(error)
        for warning in log.warnings:
            _warn(f"{SOURCE}, {warning}")
        log.warnings.clear()
    if whole and rows:  # without rows, the epochs of all users would end
        yield from log.end_epoch(rows)


def _objects(line: str, number: int) -> tuple[list[Any], bool]:
    """Return a line's rows, and whether they are a complete epoch; a bad line raises LogError."""
    try:
        content = parse_json(line)
        rows = content.get("rows", [content])
        if not all(isinstance(row, dict) for row in rows):
            raise ValueError("a row that is not an object")
    except (ValueError, TypeError, AttributeError) as error:
        raise LogError(
            f"{SOURCE}, line {number}: found {quoted(line)} ({first_line(error)}), expected a row "
            'as a JSON object, or all rows of an epoch as {"rows": [...]}'
        ) from error
    return rows, "rows" in content


def _warn(problem: object) -> None:
    print(f"warning: {printable(str(problem))[:1000]}", file=sys.stderr, flush=True)
