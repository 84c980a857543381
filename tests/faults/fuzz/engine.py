"""One reader, many cases: libFuzzer (by atheris) changes bytes where that reaches new lines.

A case is the number of a file of the reader's folder, one byte, and that file's content; the others
stay good. Beside the bytes, whole values of JSON are changed: bytes alone seldom stay JSON.
"""

import json
import os
import random
import re
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import atheris

from tests.faults.fuzz.outcomes import Tally
from tests.faults.fuzz.readers import Reader

VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 10**20, 10**400, 1e308, -1e-320, float("nan"), float("inf"), "", "much",
    "\x1b]0;owned\x07", "\ud800", "x" * 1000, "../..", [], [[]], [1.0, "a"], {}, {"mean": None},
)  # fmt: skip
_WORDS = (
    b"\r", b"\x00", b"\xff", b"1e999", b"NaN", b"Infinity", b"-1", b"null", b"true", b"[[[[[[[[",
    b"9" * 60, b"\xef\xbb\xbf", b"\x1b[31m",
)  # fmt: skip
_LARGEST = 60_000  # bytes of a case
AFRESH = 0.3  # share of cases that begin with a good file, which coverage alone soon leaves


def fuzz(reader: Reader, cases: int, seed: int, report: Path) -> None:
    """Run so many cases in this process, write what came of them, and end it.

    Args:
        reader: what reads.
        cases: how many.
        seed: of what is changed.
        report: file for counts and examples, JSON, renewed on the way: a reader may take the
            process with it.
    """
    folder, tally = TemporaryDirectory(), Tally()
    home, corpus = Path(folder.name, "case"), Path(folder.name, "corpus")
    good = reader.good()
    names, last = sorted(good), [""]
    seeds = [bytes([i]) + one[name] for one in (good, reader.also) for i, name in enumerate(names)
             if name in one]  # fmt: skip
    corpus.mkdir()
    for i, content in enumerate(seeds):
        (corpus / str(i)).write_bytes(content)
    for name in names:
        reader.write(home, name, good[name])
    words = Path(folder.name, "words")
    escaped = ("".join(f"\\x{byte:02x}" for byte in word) for word in _WORDS)
    words.write_text("".join(f'"{word}"\n' for word in escaped))

    def case(data: bytes) -> None:
        name = names[data[0] % len(names)] if data else names[0]
        if last[0] not in ("", name):
            reader.write(home, last[0], good[last[0]])
        reader.write(home, name, data[1:])
        last[0] = name
        tally.case(reader.read, home, data)
        if tally.cases % 200 == 0 or tally.cases >= cases:
            _write(report, tally)
        if tally.cases >= cases:
            folder.cleanup()
            os._exit(0)

    def changed(data: bytes, most: int, number: int) -> bytes:
        rng = random.Random(number)
        return _changed(rng.choice(seeds) if rng.random() < AFRESH else data, most, rng)

    options = [
        f"-seed={seed or 1}", f"-max_len={_LARGEST}", "-rss_limit_mb=8192",
        f"-dict={words}", f"-artifact_prefix={folder.name}/", "-verbosity=0", str(corpus),
    ]  # fmt: skip
    atheris.Setup([sys.argv[0], *options], case, custom_mutator=changed)
    atheris.Fuzz()


def _write(report: Path, tally: Tally) -> None:
    examples = [[fault, where, content.hex()] for fault, where, content in tally.examples]
    report.write_text(json.dumps({"counts": tally.counts, "examples": examples}))


def _changed(data: bytes, most: int, rng: random.Random) -> bytes:
    """Other bytes: in one case of two of JSON a value, of other text a word, that is another."""
    changed = None
    if rng.random() < 0.5:
        changed = _other_value(data[1:], rng) or _other_word(data[1:], rng)
    if changed is None or len(changed) >= most:
        found: bytes = atheris.Mutate(data, most)
        return found
    return data[:1] + changed


def _other_word(content: bytes, rng: random.Random) -> bytes | None:
    words = list(re.finditer(rb"[^\s,;:{}\[\]\"]+", content)) if content.isascii() else []
    if not words:
        return None
    begin, end = rng.choice(words).span()
    value = rng.choice(VALUES)
    word = value if isinstance(value, str) else json.dumps(value)
    return content[:begin] + word.encode("utf-8", "replace") + content[end:]


def _other_value(text: bytes, rng: random.Random) -> bytes | None:
    """JSON with a value that is another, there twice or not there."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, (dict, list)) or not content:
        return None
    _change_value(content, rng)
    return json.dumps(content).encode()


def _change_value(content: Any, rng: random.Random) -> None:
    inner, key = rng.choice(list(_places(content)))
    deed = rng.random()
    if deed < 0.6:
        inner[key] = json.loads(json.dumps(rng.choice(VALUES)))
    elif deed < 0.8:
        del inner[key]
    elif isinstance(inner, list):
        inner.append(inner[key])
    elif isinstance(inner[key], float):
        inner[key] = inner[key] * rng.choice((-1, 1000, 1e-9))


def _places(content: Any) -> Any:
    """Containers and keys of every part, none of which is too far down a list."""
    keys = list(content) if isinstance(content, dict) else list(range(min(len(content), 5)))
    for key in keys:
        yield content, key
        if isinstance(content[key], (dict, list)):
            yield from _places(content[key])
