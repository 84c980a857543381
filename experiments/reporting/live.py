"""Live localization: rows from standard input, one JSON line per epoch on standard output."""

import csv
import json
import sys
from collections.abc import Iterator
from io import TextIOWrapper
from itertools import chain
from typing import Any

from experiments.console.options import AUTO, LogArgs, require_alone, require_at_least
from experiments.console.progress import note
from experiments.reporting.log_choice import choice_of, require_one_choice, scene_of
from mmwave_env.io.files import Json, parse_json
from mmwave_env.io.lookup import printable, quoted
from mmwave_env.localization.levels import Levels
from mmwave_env.localization.location_data import location_data
from mmwave_env.localization.map_files import origin_of
from mmwave_env.localization.radio_choice import nearest_radio
from mmwave_env.localization.tracker import Position, Tracker
from mmwave_env.logs.live_log import LiveEpoch, LiveLog
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.layout import clock_from
from mmwave_env.models.scene import Scene

SOURCE = "standard input"


def run_live(args: LogArgs) -> None:
    """Read rows until the end of the input; print the estimated position after each epoch.

    A damaged or late row causes a warning and is left out.

    Raises:
        ValueError: options contradict each other, or line 1 is neither a header nor JSON.
    """
    if str(args.log) != "-" or args.scene is None:
        raise ValueError('live: needs "-" (standard input) as the log, and --scene')
    files = ("sample", "truth", "out", "plot", "json")
    require_alone(args, "live", *files, "two_way", "associate", "diagnose", "odometry")
    require_alone(args, "format", "lag")
    require_at_least(0, args, "lag")
    require_one_choice(args)
    if not 0.0 < args.confidence < 1.0:
        raise ValueError(f"confidence: found {args.confidence}, expected between 0 and 1")
    levels = Levels(args.risk, args.levels)
    scene = scene_of(args, args.scene)
    origin = origin_of(scene, "format: 3gpp") if args.format == "3gpp" else None
    tracker = None
    began = False
    for epoch in _epochs(scene, args.snr, clock_from(args.clock)):
        if tracker is None:
            log = epoch.log()
            if not log.visible[:, : log.layout.anchors].any():
                continue
            radio = nearest_radio(log, scene) if args.radio == AUTO else args.radio
            choice = choice_of(args, radio, log)
            tracker = Tracker(
                scene, choice.switching, radio, height_m=args.height, lag=max(args.lag, 1),
                levels=levels,
            )  # fmt: skip
        position = tracker.step(epoch)
        if position:
            if not began:
                note(f"a new track begins: modes {choice.why}, radio {radio}")
            elif position.begins:
                note(f"a new track begins at {position.time_s!r} s")
            late = tracker.smoothed() if args.lag else None
            content = _content(position) | ({"smoothed": _content(late)} if late else {})
            if origin:
                content = location_data(position, origin, args.confidence, args.accuracy)
            print(json.dumps(content), flush=True)
            began = True
    if not began:
        _warn(f"{SOURCE}: found no epoch that determines a position")


def _content(position: Position) -> Json:
    """Return the content of an output line; leave out unknown values."""
    return {name: value for name, value in position._asdict().items() if value is not None}


def _epochs(scene: Scene, snr_db: float | None, clock: bool) -> Iterator[LiveEpoch]:
    """Read rows (CSV below a header, or JSON objects); yield the epochs that they form.

    A JSON object is one row, or a whole epoch: {"rows": [...]}.
    """
    assert isinstance(sys.stdin, TextIOWrapper)
    # Bytes that are no text become escape codes, which a row's checks refuse.
    sys.stdin.reconfigure(encoding="utf-8-sig", errors="backslashreplace")
    lines: Iterator[tuple[int, str]] = enumerate(map(str.rstrip, sys.stdin), start=1)
    number, first = next(((number, line) for number, line in lines if line), (0, ""))
    if not first:
        raise ValueError(f"log: found nothing on {SOURCE}, expected a header or JSON lines")
    as_json = first.lstrip().startswith("{")
    delimiter = "," if "," in first else ";"
    if as_json:
        names = dict.fromkeys(name for row in _objects(first, number)[0] for name in row)
        lines = chain([(number, first)], lines)
    else:
        header = next(csv.reader([first], delimiter=delimiter))
        names = dict.fromkeys(name.strip() for name in header)
    log = LiveLog([*names], scene, snr_db, SOURCE, clock, "," if as_json else delimiter)
    for number, line in lines:
        try:
            rows, whole = _objects(line, number) if as_json else ([line], False)
        except LogError as error:
            _warn(error)
            continue
        for row in rows:
            try:
                yield from log.add(row, number)
            except LogError as error:
                _warn(error)
            for warning in log.warnings:
                _warn(f"{SOURCE}, {warning}")
            log.warnings.clear()
        if whole:
            yield from log.end_epoch()
    yield from log.end_epoch()


def _objects(line: str, number: int) -> tuple[list[Any], bool]:
    """Return a line's rows, and whether they are a complete epoch; a bad line raises LogError."""
    try:
        content = parse_json(line)
        rows = content.get("rows", [content])
        if not all(isinstance(row, dict) for row in rows):
            raise ValueError("a row that is not an object")
    except (ValueError, TypeError, AttributeError) as error:
        raise LogError(
            f"{SOURCE}, line {number}: found {quoted(line)}, expected a row as a JSON object, or "
            'all rows of an epoch as {"rows": [...]}'
        ) from error
    return rows, "rows" in content


def _warn(problem: object) -> None:
    print(f"warning: {printable(str(problem))[:1000]}", file=sys.stderr, flush=True)
