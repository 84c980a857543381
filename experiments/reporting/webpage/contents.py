"""Contents of the web page: results as verdicts, tables and learning curves in HTML."""

import csv
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from html import escape
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from experiments.console.output import cells_of, unescaped
from experiments.evaluation.compare import Comparison
from experiments.evaluation.contenders import DESCRIPTIONS, named, outcomes_markdown
from experiments.evaluation.positions import positions_markdown
from experiments.reporting.figures import draw_learning_curves
from experiments.reporting.track_report import track_markdown
from mmwave_env.io.files import Json, first_line, read_json, read_text
from mmwave_env.io.lookup import printable

SHOWN = 5  # number of table rows that are shown at first


def text(value: Any) -> str:
    """Escape text for HTML, including quoted attributes; spell out unprintable characters."""
    return escape(printable(str(value)))


def element(tag: str, words: Any, kind: str = "") -> str:
    """Return an HTML element that contains plain text."""
    return f"<{tag}{kind and f' class={kind}'}>{text(words)}</{tag}>"


def table(caption: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table of plain text that scrolls sideways; the first cell of each row names the row.

    Rows after the first :data:`SHOWN` are hidden until a box is checked; this needs no script.
    """
    head = "".join(f'<th scope="col">{text(title)}</th>' for title in header)
    body = "".join(
        f'<tr><th scope="row">{text(name)}</th>{"".join(element("td", c) for c in cells)}</tr>'
        for name, *cells in rows
    )
    more = f'<label><input type="checkbox"> Show all {len(rows)} rows</label>'
    return (
        f'<div class="table">{element("p", caption, "caption") if caption else ""}'
        f'<div class="scroll" tabindex="0" role="region" aria-label="{text(caption or header[0])}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
        f"{more if len(rows) > SHOWN else ''}</div>"
    )


def html_of(markdown: str) -> str:
    """Return tables, paragraphs and list items of a command's Markdown as HTML."""
    parts = []
    for block in markdown.strip().split("\n\n"):
        if block.startswith("|"):
            header, _, *rows = cells_of(block)
            parts.append(table("", header, rows))
        else:
            lines = block.strip().splitlines()
            parts += [element("p", unescaped(line.removeprefix("- "))) for line in lines]
    return "".join(parts)


def drawn(caption: str, draw: Callable[..., None], *data: Any) -> str:
    """Return a picture of data as HTML; without matplotlib, return a note.

    ``draw`` gets the data and the path of an .svg file to write. In dark mode, the
    page's style inverts the picture.
    """
    if not find_spec("matplotlib"):
        return element("p", f"{caption}: pictures need mmwave-loc[plot]", "note")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "picture.svg"
        draw(*data, path)
        svg = b64encode(path.read_bytes()).decode("ascii")
    image = f'<img src="data:image/svg+xml;base64,{svg}" alt="{text(caption)}">'
    return f"<figure>{image}{element('figcaption', caption)}</figure>"


def curves_of(log: Path) -> dict[str, tuple[list[float], list[float]]]:
    """Read the learning curves in a log: for each rival, steps and reward minus its reward.

    Raises:
        ValueError: the log is not CSV, or a value is not a number; the message names the line.
    """
    curves: dict[str, tuple[list[float], list[float]]] = {}
    rows = csv.DictReader(StringIO(read_text(log, "the progress log of a training"), newline=""))
    try:
        for row in rows:
            for name, value in row.items():
                if value and name.startswith("tuning/minus "):
                    steps, values = curves.setdefault(name.split(" ", 1)[1], ([], []))
                    steps.append(float(row["timesteps"]))
                    values.append(float(value))
    except (csv.Error, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{log}: line {rows.line_num}: {first_line(error)[:300]}") from error
    return curves


READ = "results (--json) of compare, demo or localize, or a folder that train wrote"


class Source(NamedTuple):
    """Results of one command."""

    path: str  # path as the user typed it
    kind: str  # "comparison", "track" or "run"
    content: Json  # content of a file; or a run's summary, with learning curves as "curves"


def read_source(path: Path) -> Source:
    """Read a file of results, or the folder of a finished or unfinished run.

    Raises:
        ValueError: the file does not hold results; the message names the file and what it lacks.
        FileNotFoundError: there is no such file.
    """
    over = path / "summary.json"
    begun = path / "run.json"
    if over.is_file():
        run = read_json(over, "the summary of a run", dict)
    elif begun.is_file():
        run = read_json(begun, "the manifest of a run", dict)
        outcomes = sorted(path.glob("seed-*/outcome.json"))
        run["seeds"] = [read_json(file, "the outcome of a training", dict) for file in outcomes]
    else:
        content = read_json(path, "results", dict)
        return Source(str(path), "track" if "groups" in content else "comparison", content)
    logs = sorted(path.glob("seed-*/progress.csv"))
    run["curves"] = {file.parent.name: curves_of(file) for file in logs}
    return Source(str(path), "run", run)


WORDS = (
    "reward: per epoch, minus the position error in m, and minus a penalty if the filter misjudges "
    "its error. ATE: mean position error. RMSE: root of the mean square error. RPE: change of the "
    "error within a second. NEES: squared error relative to the filter's own covariance; 3 is "
    "right (2 on flat ground), more is too confident. diverged: share of episodes whose error "
    "exceeds 50 m at some time. Wide tables scroll sideways."
)


class Verdict(NamedTuple):
    """A name for results, their outcome as a title and as a sentence, and HTML of their tables."""

    name: str
    title: str
    sentence: str
    tables: str


def verdict_on(source: Source) -> Verdict:
    """Return the verdict on the results of a source.

    Raises:
        KeyError, TypeError, ValueError, AttributeError: the content is not complete.
    """
    content = source.content
    if source.kind == "track":
        log = content["log"]
        times = f"{content['first_s']:.13g} to {content['last_s']:.13g} s"
        title = f"{content['epochs']} epochs of {log}, {times}"
        facts = [title]
        for name, row in content.get("truth", {"tracks": {}})["tracks"].items():
            facts.append(f"the {name} track has an ATE of {row['ate_m']:.3f} m")
        if content.get("error"):
            facts.append(f"only part of the log was used: {content['error']}")
        tables = html_of(track_markdown(content))
        return Verdict(f"{log}, {content['scene']}", title, f"{'; '.join(facts)}.", tables)
    if source.kind == "run":
        seeds = content["seeds"]
        curves = content["curves"].values()
        title = f"{len(seeds)} of {len(curves)} training seeds of {source.path} are finished"
        more = "; mmwave-loc train --resume continues the other seeds"
        tables = ""
        if seeds:
            about = "The best policy of each training seed, on tuning seeds"
            tables = element("p", about, "caption") + html_of(outcomes_markdown(seeds))
        for rival in dict.fromkeys(rival for curve in curves for rival in curve):
            lines = [curve[rival] for curve in curves if rival in curve]
            caption = f"Gain in reward over {rival} on tuning seeds, a line per training seed"
            label = f"reward minus reward of {rival}"
            tables += drawn(caption, draw_learning_curves, label, lines)
        sentence = f"{title}{'' if len(seeds) == len(curves) else more}."
        return Verdict(source.path, title, sentence, tables)
    comparison = Comparison.from_json(content)
    return _verdict(comparison, "".join(_compared(comparison, content.get("position_errors"))))


def _verdict(comparison: Comparison, tables: str) -> Verdict:
    """Return the verdict on the best contender and the next contender that is paired with it."""
    best, *others = comparison.policies
    name = f"{comparison.scenario}, {comparison.radio}, {named(comparison.seeds)}"
    title = f"{best} has a reward of {comparison.policies[best]['reward']}"
    for other in others:
        by = comparison.margin(best, other)
        if by:
            level = by.low <= 0.0
            title = f"{best} and {other} are level" if level else f"{best} beats {other} by {by}"
            break
    sentence = f"{title}, in rewards per epoch: {len(comparison.policies)} policies on {name}."
    return Verdict(name, title, sentence, tables)


def _compared(comparison: Comparison, positions: Json | None) -> Iterator[str]:
    header, rows = comparison.table()
    yield table("Means ± half the widths of 95 % intervals, best reward first", header, rows)
    pairs = [
        [name, other, pair["reward"], pair["ate_m"]]
        for name in comparison.policies
        for other in comparison.policies
        if (pair := comparison.paired.get(f"{name} - {other}"))
    ]
    caption = "Differences, paired by episode, with 95 % intervals"
    yield table(caption, ["policy", "minus", "reward", "ATE m"], pairs) if pairs else ""
    if positions:
        rows = positions["policies"]
        ranked = {name: rows[name] for name in comparison.policies if name in rows}
        about = "Errors in all episodes, without the first 10 epochs of each"
        yield element("p", about, "caption")
        kind = positions.get("levels", "gaussian")
        yield html_of(positions_markdown("policy", ranked, positions["risk"], kind))
    for name in comparison.policies:
        if name in DESCRIPTIONS:
            yield element("p", f"{name}: {DESCRIPTIONS[name]}", "caption")
    yield element("p", WORDS, "caption")


def origin_of(title: str, command: str, versions: Json) -> str:
    """Return HTML with the command and the package versions that made results or this page."""
    made = ", ".join(f"{name} {version}" for name, version in versions.items())
    parts = element("h3", title), element("pre", command)
    return "".join(parts) + (element("p", f"Made with {made}.") if versions else "")
