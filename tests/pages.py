"""Helpers that run code blocks of the docs; ``python -m tests.pages PAGE`` renews a page's tables.

For a notebook (``docs/notebooks/corrector.ipynb``), it renews the stored outputs.

A comment above a block says what is done with the block:

- ``<!-- example -->``: the block is run. All Python blocks of a page share one session, lines that
  begin with ``mmwave-loc`` are run as commands, and functions named test_... are called.
- ``<!-- example: ride.csv -->``: the block is written to this file, which other blocks can read.
- ``<!-- example: few -->``: the block is run with only 2 episodes and 4096 time steps of training.
- ``<!-- example: slow -->``: only slow tests run the block; ``few`` and ``slow`` can be combined.
- ``<!-- published -->``: the block takes minutes or more and is run only to renew tables.
- ``<!-- not run: why -->``: the block is never run; the comment says why.

The output of a block is shown below it, between ``<!-- table: printed -->`` and ``<!-- end -->``.
If text follows ``printed``, only the first table at or below a line that begins with this text is
shown. If a file name precedes ``printed``, the file (written by the block) replaces the output.
After the text, ``; rows: A + B`` and ``; columns: C + D`` keep only some rows and columns.
"""

import os
import re
import shlex
import sys
from contextlib import chdir, contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from itertools import dropwhile, takewhile
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from tests.cli import environment, succeed
from tests.paths import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:^<!-- (?P<mark>(?:example|published|not run)[^\n]*?) -->\n)?"
    r"^```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.DOTALL | re.MULTILINE,
)
TABLE = re.compile(
    r"^<!-- table: (?P<file>\S+ )?printed ?(?P<begin>.*?)(?:; rows: (?P<rows>.*?))?"
    r"(?:; columns: (?P<columns>.*?))? -->\n(?P<shown>.*?)^<!-- end -->$",
    re.DOTALL | re.MULTILINE,
)
NUMBER = re.compile(r"-?\d[\d,]*(?:\.\d+)?")


@dataclass
class Block:
    """A code block of a page, with the tables below it that show its output."""

    language: str
    text: str
    line: int  # number of the page's line that opens the block, counted from 1
    mark: str  # text of the comment above the block; "" if there is none
    tables: list

    @property
    def words(self):
        """Return the words after the colon of the mark."""
        return self.mark.partition(":")[2].split()

    @property
    def file(self):
        """Return the name of the file to which the block is written; "" if the block is run."""
        return next((word for word in self.words if "." in word), "")

    @property
    def commands(self):
        """Return the text after ``mmwave-loc`` of every line that begins with it."""
        return re.findall(r"^mmwave-loc (.*)$", self.text.replace("\\\n", " "), re.MULTILINE)


def blocks_of(page):
    """Return all blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    matches = list(BLOCK.finditer(text))
    ends = [*(match.start() for match in matches[1:]), len(text)]
    blocks = []
    for match, end in zip(matches, ends, strict=False):  # a page without blocks has one end
        line = text.count("\n", 0, match.start("text"))
        tables = TABLE.finditer(text, match.end(), end)
        blocks.append(Block(match["language"], match["text"], line, match["mark"] or "", [*tables]))
    return blocks


class Session:
    """A session that runs the blocks of one page, in a folder of its own.

    Args:
        page: page whose blocks are run.
        folder: empty folder, to which the session adds links to docs/ and experiments/.
    """

    def __init__(self, page, folder):
        self.folder = folder
        self._done = set()
        self._names = {"__name__": page.stem}
        for name in ("docs", "experiments"):
            (folder / name).symlink_to(ROOT / name)

    def printed(self, block):
        """Run a block and return its output; "" if the session has run it before."""
        if block.line in self._done:
            return ""
        self._done.add(block.line)
        if block.file:
            (self.folder / block.file).write_text(block.text, encoding="utf-8")
            return ""
        text = block.text
        if "few" in block.words:
            text = re.sub(r"(episodes[= ])[\d_]+", r"\g<1>2", text)
            text = re.sub(r"(total[_-]timesteps[= ])[\d_]+", r"\g<1>4096", text)
        if block.language != "python":
            lines = replace(block, text=text).commands
            with self._inside():
                return "".join(succeed(*shlex.split(line), cwd=self.folder) for line in lines)
        out = StringIO()
        with redirect_stdout(out), self._inside():
            before = set(self._names)
            exec(compile("\n" * block.line + text, "example", "exec"), self._names)
            for name in set(self._names) - before:
                if name.startswith("test_"):
                    self._names[name]()
        return out.getvalue()

    @contextmanager
    def _inside(self):
        """Let a block import modules from the folder, and unload these modules afterwards."""
        before = list(sys.path)  # loading an agent by name adds the current folder to sys.path
        sys.path.insert(0, str(self.folder))
        try:
            with chdir(self.folder):
                yield
        finally:
            sys.path[:] = before
            for name, module in list(sys.modules.items()):
                if str(getattr(module, "__file__", "")).startswith(str(self.folder)):
                    del sys.modules[name]


def made(table, printed, folder):
    """Return the lines to show between the marks of a table, from the output of its block."""
    text = (folder / table["file"].strip()).read_text() if table["file"] else printed
    if not table["begin"]:
        return f"\n{text.partition('Written:')[0].strip()}\n\n"  # without the list of files
    lines = text.splitlines()
    begin = next((i for i, line in enumerate(lines) if line.startswith(table["begin"])), None)
    if begin is None:
        raise ValueError(f"table of the page: found no line that begins with {table['begin']!r}")
    rows = dropwhile(lambda line: not line.startswith("|"), lines[begin:])
    kept = cut(
        [*takewhile(lambda line: line.startswith("|"), rows)], table["rows"], table["columns"]
    )
    return "\n".join(kept) + "\n"


def cut(lines, rows, columns):
    """Return the lines of a table with only some rows (by their first cells) and columns."""
    cells = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines]
    header = cells[0]
    body = cells[2:]
    if rows:
        body = [row for row in body if row[0] in rows.split(" + ")]
    places = list(range(len(header)))
    if columns:
        places = [header.index(name) for name in columns.split(" + ")]
    rest = [f"| {' | '.join(row[i] for i in places)} |" for row in (header, *body)]
    return [rest[0], "|" + "---|" * len(places), *rest[1:]]


def renewed(page):
    """Return the text of the page with all tables renewed by running its blocks."""
    text = page.read_text(encoding="utf-8")
    changes = []
    with TemporaryDirectory() as folder:
        session = Session(page, Path(folder))
        for block in blocks_of(page):
            if block.mark.startswith(("example", "published")):
                printed = session.printed(block)
                changes += [
                    (t.span("shown"), made(t, printed, session.folder)) for t in block.tables
                ]
    for (begin, end), shown in reversed(changes):
        text = text[:begin] + shown + text[end:]
    return text


def run_notebook(path):
    """Run a notebook in its folder, as Jupyter does; return it with the new outputs.

    Details of the run, such as counts, are left out, and so are progress bars.
    """
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    folder = {"metadata": {"path": path.parent}}
    with patch.dict(os.environ, PYTHONPATH=environment()["PYTHONPATH"]):
        nbclient.NotebookClient(notebook, resources=folder, timeout=600).execute()
    notebook.metadata.language_info = {"name": "python"}
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.execution_count = None
            cell.outputs = [_stored(o) for o in cell.outputs if o.get("name") != "stderr"]
    return notebook


def _stored(output):
    if "data" in output:
        output.data.pop("image/jpeg", None)
        output.execution_count = None
    return output


def renew(path):
    """Renew the tables of a page, or the stored outputs of a notebook."""
    if path.suffix == ".md":
        path.write_text(renewed(path), encoding="utf-8")
        return
    import nbformat

    nbformat.write(run_notebook(path), path)


if __name__ == "__main__":
    for word in sys.argv[1:]:
        renew(Path(word))
