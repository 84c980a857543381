"""Results as commands left them, read and checked: what a page is made of."""

import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from experiments.evaluation.outcomes import require_outcome
from experiments.webpage.kinds import (
    COMPARISON,
    DEFAULTS,
    ENTRY,
    EVOLUTION,
    GAINS,
    RUN,
    SWEEP,
    TRACK,
    TRANSFER,
    TRUST,
    Kind,
)
from experiments.webpage.runs import read_run
from experiments.webpage.source import Source, read_object, words, writer_of
from mmwave_env import __version__
from mmwave_env.files import told

MADE = ("command", "versions")
Reader = Callable[[str, Mapping[str, Any]], list[Source]]  # of a file's name and content


def read_source(path: Path) -> list[Source]:
    """What is in a file of results, or in a folder: a run, or files of results and runs.

    Raises:
        ValueError: naming the file, the key, and the version that wrote it.
        FileNotFoundError: there is no such file.
    """
    if path.is_dir():
        found = list(_in_folder(path))
        if not found:
            raise ValueError(
                f"{path}: found neither run.json nor results (--json) in it, expected a folder of "
                "train, of results or of a sweep that is over"
            )
        return found
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: found no file, expected results (--json) of {words(READERS)}, or the "
            "folder of a run of train"
        )
    content = read_object(path)
    if "command" not in content and content and all(map(_is_made, content.values())):
        return [
            one for part, of_part in content.items() for one in _read(f"{path}: {part}", of_part)
        ]  # demo --json
    return _read(str(path), content)


def _in_folder(path: Path) -> Iterator[Source]:
    """A run; or whatever a folder holds, but for files that say how to train, and hidden ones."""
    if (path / "run.json").is_file():
        yield read_run(path)
        return
    for one in sorted(path.iterdir()):
        if one.is_dir() and not one.name.startswith("."):
            yield from _in_folder(one)
        elif one.suffix == ".json" and _is_shown(read_object(one)):
            yield from read_source(one)


def _is_shown(content: Mapping[str, Any]) -> bool:
    """Whether a file in a folder is results of a command that pages show; others may lie there."""
    made = [content] if "command" in content else [one for one in content.values() if _is_made(one)]
    words = [_split(one.get("command"))[1:2] for one in made]
    return any(word and word[0] in READERS for word in words)


def _is_made(content: Any) -> bool:
    return isinstance(content, dict) and "command" in content


def _read(name: str, content: Mapping[str, Any]) -> list[Source]:
    """Results of a command."""
    typed = _split(content.get("command"))
    command = typed[1] if len(typed) > 1 and typed[0] == "mmwave-loc" else ""
    if command not in READERS:
        found = f"the command {command!r}" if command else "no command of mmwave-loc"
        raise ValueError(
            f"{name}: command: found {found}, written by {writer_of(content.get('versions'))}; "
            f"mmwave-loc {__version__} reads results of {words(READERS)}"
        )
    return READERS[command](name, content)


def _split(command: Any) -> list[str]:
    try:
        return shlex.split(command) if isinstance(command, str) else []
    except ValueError:
        return []


def _one_of(*kinds: Kind) -> Reader:
    """Reads results of the kind whose mark they have, or else of the last."""

    def read(name: str, content: Mapping[str, Any]) -> list[Source]:
        kind = next((one for one in kinds if one.mark in content), kinds[-1])
        return [Source.checked(name, kind, content)]

    return read


def _localized(name: str, content: Mapping[str, Any]) -> list[Source]:
    if "verdict" in content:
        writer = writer_of(content.get("versions"))
        raise ValueError(f"{name}: verdict: found a diagnosis by {writer}, expected a track")
    return [Source.checked(name, TRACK, content)]


def _learned(name: str, content: Mapping[str, Any]) -> list[Source]:
    """Every table of learned, by its title."""
    made = {key: content[key] for key in MADE if key in content}
    found = []
    for title in [key for key in content if key not in MADE]:
        part, called = content[title], f"{name}: {title}"
        if not isinstance(part, dict):
            raise ValueError(
                f"{called}: found {type(part).__name__}, written by "
                f"{writer_of(made.get('versions'))}; mmwave-loc {__version__} expects an object"
            )
        marked = (reader for mark, reader in _PARTS.items() if mark in part)
        read = _trainings if title == "trainings" else next(marked, _gains)
        found += read(called, title, part, made)
    return found


def _trainings(
    name: str, title: str, part: Mapping[str, Any], made: Mapping[str, Any]
) -> list[Source]:
    """Runs without their curves."""
    try:
        for outcomes in part.values():
            for one in outcomes:
                require_outcome(one)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name}: {told(error)}, expected outcomes of training") from error
    versions = made.get("versions", {})
    return [
        Source(run, RUN, {
            "command": made["command"], "name": run, "over": True, "seeds": outcomes, "curves": {},
        }, versions)
        for run, outcomes in part.items()
    ]  # fmt: skip


def _with_title(kind: Kind, key: str) -> Callable[..., list[Source]]:
    """Reads figures that stand under a title alone."""

    def read(
        name: str, title: str, part: Mapping[str, Any], made: Mapping[str, Any]
    ) -> list[Source]:
        return [Source.checked(name, kind, {**made, "title": title, key: part})]

    return read


def _whole(kind: Kind) -> Callable[..., list[Source]]:
    """Reads what is as another command has it; a record of its own says itself who made it."""

    def read(
        name: str, title: str, part: Mapping[str, Any], made: Mapping[str, Any]
    ) -> list[Source]:
        return [Source.checked(name, kind, part if "command" in part else {**made, **part})]

    return read


_gains = _with_title(GAINS, "gains")
_PARTS = {  # of learned, by a key in them
    COMPARISON.mark: _whole(COMPARISON),
    TRANSFER.mark: _whole(TRANSFER),
    DEFAULTS.mark: _whole(DEFAULTS),
    TRUST.mark: _with_title(TRUST, "trust"),
}
READERS: Mapping[str, Reader] = {  # by the command that wrote it
    "evaluate": _one_of(COMPARISON),
    "compare": _one_of(COMPARISON),
    "demo": _one_of(COMPARISON),
    "transfer": _one_of(TRANSFER),
    "localize": _localized,
    "leaderboard": _one_of(ENTRY),
    "learned": _learned,
    "studies": _one_of(EVOLUTION, DEFAULTS),
    "sweep": _one_of(SWEEP),
}
