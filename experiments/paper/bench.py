"""Cached runs of modes on the episodes of a setting, and the tables that show their results."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import NamedTuple

import numpy as np

from experiments.console.tables import grid
from experiments.evaluation.intervals import Interval, rounded
from experiments.evaluation.runner import Scores
from experiments.evaluation.seeds import draw_episodes
from mmwave_env.engines.engine import tracks_of
from mmwave_env.engines.smoothing import smooth
from mmwave_env.filters.bank import shipped_modes
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.metrics import scored, summary
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.linalg import unpack
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode
from mmwave_env.world.simulated import SimulatedSource

TUNED_ON = {"pedestrian": 0, "vehicle": 1}  # kind of user -> index of the mode tuned for it


@dataclass(frozen=True)
class Setting:
    """A setting that determines the episodes of a run."""

    scenario: str  # kind of user
    radio: str  # name of the radio profile
    clean: bool = False  # whether blockage and multipath are left out
    odometry: bool = False  # whether the user also measures speed and heading
    walls: bool = True  # whether there are walls, which add virtual anchors to the base station
    changes: tuple[tuple[str, object], ...] = ()  # pairs (field of the radio to change, new value)

    def source(self) -> SimulatedSource:
        """Return the source of the episodes."""
        changes = dict(self.changes)
        if self.clean:
            changes |= {"blockage_scale": 0.0, "multipath_rate_hz": 0.0}
        radio: Radio = replace(radio_from(self.radio), **changes)  # type: ignore[arg-type]
        scene = SCENES["street"] if self.walls else replace(SCENES["street"], walls=())
        return SimulatedSource(scene, radio, self.scenario, odometry=self.odometry)

    def tuned(self, coupling: bool = True) -> Mode:
        """Return the mode that was tuned for this kind of user and radio."""
        return shipped_modes(self.radio, coupling)[TUNED_ON[self.scenario]]


class Errors(NamedTuple):
    """Errors of a mode on every episode."""

    scores: Scores  # values (episodes,) by metric
    nees: Array  # (episodes, epochs) without the first epochs of an episode (the burn-in)
    axis_rms_m: Array  # (3,) root mean square error along x, y and z


class TrackRun(NamedTuple):
    """Errors of a mode's tracks, before and after Rauch-Tung-Striebel smoothing."""

    filtered: Errors
    smoothed: Errors


class Bench:
    """A cache of modes' runs on the episodes with seeds ``seed .. seed + episodes - 1``."""

    def __init__(self, episodes: int, seed: int) -> None:
        self.count = episodes
        self.seed = seed
        self.episodes = cache(self._draw)
        self.run = cache(self._run)

    def _draw(self, setting: Setting) -> list[Episode]:
        return draw_episodes(setting.source(), range(self.seed, self.seed + self.count))

    def ates(self, modes: Iterable[Mode], setting: Setting) -> list[Array]:
        """Return the ATE (episodes,) of the filtered track of each mode, m."""
        return [self.run(mode, setting).filtered.scores["ate_m"] for mode in modes]

    def _run(self, mode: Mode, setting: Setting, planar: bool = False) -> TrackRun:
        """Filter and smooth every episode of a setting; if ``planar``, z and vz are known."""
        episodes = self.episodes(setting)
        if planar:
            height = SCENES["street"].streets.height_m
            episodes = [episode.on_flat_ground(height) for episode in episodes]
        return track(mode, episodes, planar)


def track(mode: Mode, episodes: Sequence[Episode], planar: bool = False) -> TrackRun:
    """Filter and smooth episodes of the same length with a mode."""
    pipeline = Pipeline((mode,), episodes[0].layout, planar)
    tracker = tracks_of(pipeline, len(episodes))
    tracker.load(episodes)
    run = tracker.run("x", "P", "x_predicted", "P_predicted", "error", "nees")
    x, P, x_predicted, P_predicted, error, nees = run.values()
    better_x, better_P = smooth(x, P, x_predicted, P_predicted, np.diff(episodes[0].time_s), planar)
    better = error + better_x[..., :3] - x[..., :3]
    covariance = unpack(list(np.moveaxis(better_P, -1, 0)), zero=pipeline.known_axes)
    # NEES depends only on state minus truth: pass the error as the state, and 0 as the truth.
    offset = Belief(list(np.moveaxis(better, -1, 0)), covariance, pipeline.position_axes)
    axes = len(pipeline.position_axes)
    smoothed = _errors(better, offset.nees([0.0] * 3), axes)
    return TrackRun(_errors(error, nees, axes), smoothed)


def _errors(error: Array, nees: Array, axes: int) -> Errors:
    counted = scored(nees.shape[1])
    rms = np.sqrt(np.square(error[:, counted]).mean(axis=(0, 1)))
    return Errors(summary(error, nees, axes=axes), nees[:, counted], rms)


Cell = str | float | Interval
Row = list[Cell]


@dataclass
class Section:
    """A table with a title and a note."""

    title: str  # title, in Markdown
    note: str  # note below the table, in Markdown
    header: str  # headers of the columns, with " | " between them
    labels: int = 1  # number of columns at the left that together name a row
    rows: list[Row] = field(default_factory=list)

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
        out: list[Row] = []
        for row in self.rows:
            name = ", ".join(str(cell) for cell in row[: self.labels])
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
        return lambda bench: Section(title, note, header, labels, [*rows(bench)])

    return decorate


def shown(cell: Cell) -> str:
    """Return the text of a cell."""
    if isinstance(cell, Interval):
        return rounded(cell)
    return cell if isinstance(cell, str) else f"{cell:.3g}" if cell < 1e4 else f"{cell:.2e}"
