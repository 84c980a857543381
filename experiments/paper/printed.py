"""Tables I, II and III with the paper's printed values (arXiv 2510.06861) and our values.

Short forms of the sections come first; verdicts.csv lists the rows of the last of these.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.console.tables import grid
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.runner import Scores
from experiments.paper.bench import Bench, Row, Section, Setting, section, shown
from mmwave_env.filters.modes import Mode, robust
from mmwave_env.models.radio import TUNED_RADIOS


class Published(NamedTuple):
    """The values in a row of the paper's Table I or II, in the printed order."""

    ate_m: float
    rpe_m: float
    nees: float
    rmse_m: float


LOW_MOBILITY = {  # Table I
    "EKF": Published(0.67, 0.10, 2.40e-4, 0.30),
    "UKF": Published(0.35, 0.11, 6779.6, 0.22),
    "CKF": Published(2.72, 0.11, 2.06e5, 1.24),
    "optimized": Published(0.19, 0.02, 0.75, 0.06),
}
HIGH_MOBILITY = {  # Table II
    "EKF": Published(158.3, 2.751, 1704.3, 198.76),
    "UKF": Published(8.69, 33.99, 5.08e5, 22.32),
    "CKF": Published(12.868, 4.684, 2.59e7, 47.72),
    "optimized": Published(1.74, 0.17, 1.36e5, 0.60),
}
OTHERS = {  # Table III: method -> (scenario, ATE in meters)
    "Indoor mmWave (Karttunen et al. 2025)": ("indoor", "0.2 to 0.3"),
    "RadarSLAM (Hong et al. 2020)": ("outdoor, adverse", "5 to 13"),
}

PRINTED = {"ate_m": "ATE m", "rpe_m": "RPE m", "nees": "NEES", "rmse_m": "RMSE m"}
UNTUNED_SIGMA_V = 1.0  # m/s; our choice, because the paper states no value


def untuned(algorithm: str, coupling: bool) -> Mode:
    """Return a filter of the tables' first rows: without tuning, gates or adaptive scaling."""
    off = {"gate": None, "recovery": None, "adaptive": False}
    return Mode(algorithm, algorithm, sigma_v=UNTUNED_SIGMA_V, coupling=coupling, **off)  # type: ignore[arg-type]


def _row(name: str, printed: Published | None, forms: Sequence[Scores]) -> Row:
    """Return a row: per metric, the paper's value, then our value per form of process noise."""
    row: Row = [name]
    for metric in PRINTED:
        row.append("" if printed is None else getattr(printed, metric))
        row += bootstrap(np.stack([scores[metric] for scores in forms], axis=1))
    return row


def _rows(bench: Bench, setting: Setting, printed: dict[str, Published]) -> Iterator[Row]:
    forms = (False, True)  # forms of the process noise: plain diagonal, coupled
    for algorithm in ("ekf", "ukf", "ckf"):
        runs = [bench.run(untuned(algorithm, coupling), setting) for coupling in forms]
        name = algorithm.upper()
        yield _row(name, printed[name], [run.filtered.scores for run in runs])
    tuned = [setting.tuned(coupling) for coupling in forms]
    variants = {"": (tuned, setting), ", robust": ([*map(robust, tuned)], setting)}
    if setting.scenario == "pedestrian":
        variants[", odometry"] = tuned, replace(setting, odometry=True)
    for variant, (modes, measured) in variants.items():
        smoothed = [bench.run(mode, measured).smoothed.scores for mode in modes]
        name = f"Optimized {str(tuned[0].algorithm).upper()}{variant}"
        yield _row(name, None if variant else printed["optimized"], smoothed)


def tables_one_and_two(bench: Bench) -> Iterator[Section]:
    """Yield Table I and Table II, once for each radio profile."""
    forms = ("paper", "plain Q", "coupled Q")
    metrics = (f"{metric}: {form}" for metric in PRINTED.values() for form in forms)
    header = " | ".join(["filter", *metrics])
    for number, scenario, printed in (
        ("I", "pedestrian", LOW_MOBILITY),
        ("II", "vehicle", HIGH_MOBILITY),
    ):
        note = (
            f"{bench.count} {scenario} episodes. Untuned: sigma_v {UNTUNED_SIGMA_V:g} m/s, no "
            "gates, no adaptive scaling, no smoothing. Optimized: tuned, gated, scaled and "
            "smoothed."
        )
        if scenario == "pedestrian":
            note += " Rows with odometry have the same true tracks, but other noise."
        for radio in TUNED_RADIOS:
            rows = _rows(bench, Setting(scenario, radio), printed)
            yield Section(f"Table {number}: {scenario}, {radio}", note, header, rows=[*rows])


@section(
    "Table III",
    "The results of other authors are quoted from the paper and are from other data: they show "
    "an order of magnitude, not a ranking. Ours: tuned, gated, scaled and smoothed, coupled Q.",
    " | ".join(["method", "scenario", "ATE m: paper", *TUNED_RADIOS]),
    labels=2,
)
def table_three(bench: Bench) -> Iterator[Row]:
    """Yield the rows of Table III, with our results for coupled process noise."""
    for method, (environment, ate) in OTHERS.items():
        yield [method, environment, ate, *[""] * len(TUNED_RADIOS)]
    for name, scenario, printed in (
        ("Proposed EKF", "pedestrian", LOW_MOBILITY),
        ("Proposed UKF", "vehicle", HIGH_MOBILITY),
    ):
        row: Row = [name, scenario, printed["optimized"].ate_m]
        for setting in (Setting(scenario, radio) for radio in TUNED_RADIOS):
            smoothed = bench.run(setting.tuned(), setting).smoothed
            row += bootstrap(smoothed.scores["ate_m"][:, None])
        yield row


def summaries(sections: Mapping[str, Section]) -> str:
    """Return short forms of Tables I and II and of the claims as Markdown, from all sections."""
    with Path(__file__).with_name("verdicts.csv").open(encoding="utf-8") as file:
        rows = [_span(wanted, sections[wanted["section"]]) for wanted in csv.DictReader(file)]
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
