"""Hypothesis strategies that damage files as disks, editors or attackers might."""

import json
from copy import deepcopy

from hypothesis import strategies as st

PIECES = (
    b"", b"\r", b"\n", b"\x00", b"\xff", b"\x1b[31m", b"\xef\xbb\xbf", b"\\ud800", b'"', b",", b"#",
    b"[" * 2000, b'{"a":' * 2000, b"9" * 400, b"1e999", b"-1", b"NaN", b"Infinity", b"null",
    "\uff11".encode(), "\u202e".encode(), b"x" * 100,
)  # fmt: skip
VALUES = (
    None, True, 0, -1, 10**20, 10**400, 1e308, -1e-320, float("nan"), float("inf"), "", "much",
    "\x1b]0;owned\x07", "\ud800", "x" * 1000, "../..", [], [[]], [1.0, "a"], {}, {"mean": None},
)  # fmt: skip


@st.composite
def damaged(draw, content):
    """Draw the bytes of a file after one to three replacements, removals or insertions."""
    for _ in range(draw(st.integers(1, 3))):
        begin = draw(st.integers(0, len(content)))
        end = begin + draw(st.sampled_from((0, 1, 2, 8, len(content))))
        piece = draw(st.sampled_from(PIECES) | st.binary(max_size=4))
        content = content[:begin] + piece + content[end:]
    return content


def paths_in(content, path=()):
    """Yield the path (keys, indices) to each part of JSON content, at most five per list."""
    parts = content.items() if isinstance(content, dict) else enumerate(content[:5])
    for key, value in parts:
        yield (*path, key)
        if isinstance(value, (dict, list)):
            yield from paths_in(value, (*path, key))


@st.composite
def changed(draw, content):
    """Draw the JSON content with one or two parts replaced or removed."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 2))):
        paths = list(paths_in(content))
        if not paths:
            break
        *path, last = draw(st.sampled_from(paths))
        inner = content
        for key in path:
            inner = inner[key]
        if draw(st.booleans()):
            inner[last] = deepcopy(draw(st.sampled_from(VALUES)))
        else:
            del inner[last]
    return content


class Malicious:
    """Object that sets ``builtins.touched`` and makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        code = f"import builtins, os; builtins.touched = True; os.mkdir({str(self.path)!r})"
        return exec, (code,)
