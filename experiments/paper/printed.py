"""Tables I, II and III with the paper's printed values (arXiv 2510.06861) and our values.

The printed values are in published.csv (Tables I and II) and others.csv (other authors' results in
Table III). First come cached runs of modes on the episodes of a setting, and the tables that show
results. At the end are short forms of the tables, whose last one has the rows of verdicts.csv.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.console.output import grid
from experiments.evaluation.contenders import draw_episodes
from experiments.evaluation.intervals import Interval, bootstrap, rounded
from experiments.evaluation.runner import Scores
from mmwave_env.engines.engine import tracker_of
from mmwave_env.engines.smoothing import SMOOTHED, smooth
from mmwave_env.filters.bank import shipped_modes
from mmwave_env.filters.modes import Mode, robust
from mmwave_env.metrics import scored, summary
from mmwave_env.models.radio import TUNED_RADIOS, radio_from
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode
from mmwave_env.world.simulated import SimulatedSource

TUNED_ON = ("pedestrian", "vehicle")  # kinds of users, in the order of the modes tuned for them
ALGORITHMS = ("ekf", "ukf", "ckf")


@dataclass(frozen=True)
class Setting:
    """A setting that determines the episodes of a run."""

    scenario: str  # kind of user
    radio: str  # name of the radio profile
    odometry: bool = False  # whether the user also measures speed and heading
    walls: bool = True  # whether there are walls, which add virtual anchors to the base station
    clean: bool = False  # whether there are no blockage and no multipath

    def source(self) -> SimulatedSource:
        """Return the source of the episodes."""
        radio = radio_from(self.radio)
        if self.clean:
            radio = replace(radio, blockage_scale=0.0, multipath_rate_hz=0.0)
        scene = SCENES["street"] if self.walls else replace(SCENES["street"], walls=())
        return SimulatedSource(scene, radio, self.scenario, odometry=self.odometry)

    def tuned(self, coupling: bool = True) -> Mode:
        """Return the mode that was tuned for this kind of user and radio."""
        return shipped_modes(self.radio, coupling)[TUNED_ON.index(self.scenario)]


class Errors(NamedTuple):
    """Errors of a mode on every episode."""

    scores: Scores  # values (episodes,) by metric
    nees: Array  # (episodes, epochs) without the first epochs of an episode (the burn-in)


class TrackRun(NamedTuple):
    """Errors of a mode's tracks, before and after Rauch-Tung-Striebel smoothing."""

    filtered: Errors
    smoothed: Errors


class Bench:
    """A cache of modes' runs on the episodes with seeds ``seed .. seed + episodes - 1``.

    ``run`` maps a mode, a setting and, perhaps, ``planar`` to the :class:`TrackRun` of all episodes
    of the setting; if planar, z and vz are known.
    """

    def __init__(self, episodes: int, seed: int) -> None:
        self.count = episodes
        seeds = range(seed, seed + episodes)
        self.episodes = cache(lambda setting: draw_episodes(setting.source(), seeds))
        self.run = cache(
            lambda mode, setting, planar=False: track(mode, self.episodes(setting), planar)
        )

    def ates(self, modes: Iterable[Mode], setting: Setting) -> list[Array]:
        """Return the ATE (episodes,) of the filtered track of each mode, m."""
        return [self.run(mode, setting).filtered.scores["ate_m"] for mode in modes]


def track(mode: Mode, episodes: Sequence[Episode], planar: bool = False) -> TrackRun:
    """Filter and smooth episodes of the same length with a mode."""
    tracker = tracker_of(mode, episodes, planar)
    tracks, x, error, nees = tracker.run(SMOOTHED, "x", "error", "nees").values()
    dt = np.diff([episode.time_s for episode in episodes], prepend=0.0)
    smoothed_x, P = smooth(tracker.pipeline, tracks, dt, episodes[0].hz_per_mps)
    better = error + (smoothed_x - x)[..., :3]
    # NEES depends only on state minus truth: pass the error as the state, and 0 as the truth.
    offset = tracker.pipeline.belief([*better.T], [*P.T])
    axes = len(offset.axes)
    smoothed = _errors(better, offset.nees([0.0] * 3).T, axes)
    return TrackRun(_errors(error, nees, axes), smoothed)


def _errors(error: Array, nees: Array, axes: int) -> Errors:
    counted = scored(nees.shape[1])
    # The cache keeps a copy: a view would keep all outputs of the run.
    return Errors(summary(error, nees, axes=axes), nees[:, counted].copy())


Cell = str | float | Interval
Row = list[Cell]


class Section(NamedTuple):
    """A table with a title and a note."""

    title: str  # title, in Markdown
    note: str  # note below the table, in Markdown
    header: str  # headers of the columns, with " | " between them
    rows: list[Row]
    labels: int = 1  # number of columns at the left that together name a row

    @property
    def columns(self) -> list[str]:
        """Return the headers of the columns."""
        return self.header.split(" | ")

    def markdown(self) -> str:
        """Return the title, the table and its note as Markdown."""
        rows = [[shown(cell) for cell in row] for row in self.rows]
        return f"### {self.title}\n\n{grid(self.columns, rows)}\n\n{self.note}\n"

    def records(self) -> list[Row]:
        """Return a row [section, row, column, mean, low, high] for every number."""
        out = []
        for row in self.rows:
            name = ", ".join(map(str, row[: self.labels]))
            for column, cell in zip(self.columns[self.labels :], row[self.labels :], strict=True):
                if isinstance(cell, Interval):
                    ends = (cell.low, cell.high) if cell.known else ("", "")
                    out.append([self.title, name, column, cell.mean, *ends])
                elif isinstance(cell, float):
                    out.append([self.title, name, column, cell, "", ""])
        return out


Rows = Callable[[Bench], Iterator[Row]]


def section(
    title: str, note: str, header: str, labels: int = 1
) -> Callable[[Rows], Callable[[Bench], Section]]:
    """Return a decorator that turns a generator of rows into a function that returns a section."""

    def decorate(rows: Rows) -> Callable[[Bench], Section]:
        return lambda bench: Section(title, note, header, [*rows(bench)], labels)

    return decorate


def shown(cell: Cell) -> str:
    """Return the text of a cell."""
    if isinstance(cell, Interval):
        return rounded(cell)
    return cell if isinstance(cell, str) else f"{cell:.3g}" if cell < 1e4 else f"{cell:.2e}"


def read_table(name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file in this folder."""
    with Path(__file__).with_name(name).open(encoding="utf-8") as file:
        return [*csv.DictReader(file)]


PRINTED = {"ate_m": "ATE m", "rpe_m": "RPE m", "nees": "NEES", "rmse_m": "RMSE m"}


def published(scenario: str) -> dict[str, dict[str, float]]:
    """Return the rows of the paper's Table I or II, by filter: the value of each metric."""
    return {
        row["filter"]: {metric: float(row[metric]) for metric in PRINTED}
        for row in read_table("published.csv")
        if row["scenario"] == scenario
    }


COUPLINGS = (False, True)  # forms of the process noise: plain diagonal, coupled
UNTUNED_SIGMA_V = 1.0  # m/s; our choice, because the paper states no value


def untuned(algorithm: str, coupling: bool) -> Mode:
    """Return a filter of the tables' first rows: without tuning, gates or adaptive scaling."""
    return Mode(
        algorithm,
        algorithm,
        sigma_v=UNTUNED_SIGMA_V,
        coupling=coupling,
        gate=None,
        recovery=None,
        adaptive=False,
    )


def _row(name: str, printed: Mapping[str, float], forms: Sequence[Scores]) -> Row:
    """Return a row: per metric, the paper's value, then our value per form of process noise."""
    row: Row = [name]
    for metric in PRINTED:
        row.append(printed.get(metric, ""))
        row += bootstrap([scores[metric] for scores in forms])
    return row


def tables_one_and_two(bench: Bench) -> Iterator[Section]:
    """Yield Table I and Table II, once for each radio profile."""
    forms = ("paper", "plain Q", "coupled Q")
    metrics = (f"{metric}: {form}" for metric in PRINTED.values() for form in forms)
    header = " | ".join(["filter", *metrics])
    for number, scenario in zip(("I", "II"), TUNED_ON, strict=True):
        printed = published(scenario)
        note = (
            f"{bench.count} {scenario} episodes. Untuned: sigma_v {UNTUNED_SIGMA_V:g} m/s, no "
            "gates, no adaptive scaling, no smoothing. Optimized: tuned, gated, scaled and "
            "smoothed."
        )
        if scenario == "pedestrian":
            note += " Rows with odometry have the same true tracks, but other noise."
        for radio in TUNED_RADIOS:
            setting = Setting(scenario, radio)
            rows = []
            for algorithm in ALGORITHMS:
                runs = [bench.run(untuned(algorithm, coupling), setting) for coupling in COUPLINGS]
                name = algorithm.upper()
                rows.append(_row(name, printed[name], [run.filtered.scores for run in runs]))
            tuned = [setting.tuned(coupling) for coupling in COUPLINGS]
            variants = {"": (tuned, setting), ", robust": ([*map(robust, tuned)], setting)}
            if scenario == "pedestrian":
                variants[", odometry"] = tuned, replace(setting, odometry=True)
            for variant, (modes, measured) in variants.items():
                smoothed = [bench.run(mode, measured).smoothed.scores for mode in modes]
                name = f"Optimized {str(tuned[0].algorithm).upper()}{variant}"
                rows.append(_row(name, {} if variant else printed["optimized"], smoothed))
            yield Section(f"Table {number}: {scenario}, {radio}", note, header, rows)


@section(
    "Table III",
    "The results of other authors are quoted from the paper and are from other data: they show "
    "an order of magnitude, not a ranking. Ours: tuned, gated, scaled and smoothed, coupled Q.",
    " | ".join(["method", "scenario", "ATE m: paper", *TUNED_RADIOS]),
    labels=2,
)
def table_three(bench: Bench) -> Iterator[Row]:
    """Yield the rows of Table III, with our results for coupled process noise."""
    for other in read_table("others.csv"):
        yield [*other.values(), *[""] * len(TUNED_RADIOS)]
    for name, scenario in zip(("Proposed EKF", "Proposed UKF"), TUNED_ON, strict=True):
        row: Row = [name, scenario, published(scenario)["optimized"]["ate_m"]]
        for setting in (Setting(scenario, radio) for radio in TUNED_RADIOS):
            smoothed = bench.run(setting.tuned(), setting).smoothed
            row += bootstrap([smoothed.scores["ate_m"]])
        yield row


def summaries(sections: Mapping[str, Section]) -> str:
    """Return short forms of Tables I and II and of the claims as Markdown, from all sections."""
    rows = [_span(row, sections[row["section"]]) for row in read_table("verdicts.csv")]
    claims = grid(["quantity", "paper", "ours, least", "ours, most"], rows)
    return (
        f"### Table I\n\n{_beside('Table I: pedestrian', sections)}\n\n"
        f"### Table II\n\n{_beside('Table II: vehicle', sections)}\n\n"
        f"### Claims\n\n{claims}\n"
    )


def _beside(title: str, sections: Mapping[str, Section]) -> str:
    """Return the paper's rows of Table I or II, with our values for coupled process noise."""
    rows = []
    for same in zip(*(sections[f"{title}, {radio}"].rows for radio in TUNED_RADIOS), strict=True):
        for column, metric in enumerate(PRINTED.values()):
            if paper := same[0][1 + 3 * column]:
                ours = (shown(row[3 + 3 * column]) for row in same)
                rows.append([same[0][0], metric, shown(paper), *ours])
    return grid(["filter", "figure", "paper", *TUNED_RADIOS], rows)


def _span(wanted: Mapping[str, str], of: Section) -> list[str]:
    """Return the least and the greatest value in some rows, each with the labels of its row."""

    def value(row: Row) -> float:
        cell = row[column]
        return cell.mean if isinstance(cell, Interval) else float(cell)

    column = of.columns.index(wanted["column"])
    among = set(wanted["among"].split("; ")) - {""}
    rows = sorted((row for row in of.rows if among <= {*row[: of.labels]}), key=value)
    cells = [wanted["quantity"], wanted["paper"]]
    for row in (rows[0], rows[-1]):
        labels = [str(label) for label in row[: of.labels] if label not in among]
        cells.append(shown(row[column]) + (f" ({', '.join(labels)})" if labels else ""))
    return cells
