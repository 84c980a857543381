"""Kinds of results: which keys each has, and what must be behind them."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from experiments.evaluation.entries import require_entry
from experiments.evaluation.outcomes import is_number, require_interval
from experiments.evaluation.positions import kinds_of
from experiments.evaluation.seeds import Selection


def _require_table(key: str, table: Any) -> None:
    """Refuse what is no table of intervals: rows by name, each by column."""
    if not isinstance(table, dict):
        raise ValueError(f"{key}: found {type(table).__name__}, expected an object")
    for name, row in table.items():
        for column, found in row.items():
            require_interval(f"{key}.{name}.{column}", found)


def _require_lists(key: str, table: Mapping[str, Any], *names: str) -> None:
    """Refuse lines that do not have a number, or null, at every place."""
    if len({len(table[name]) for name in names}) != 1:
        raise ValueError(f"{key}: found {', '.join(names)} of different lengths")
    for name in names:
        if not all(value is None or is_number(value) for value in table[name]):
            raise ValueError(f"{key}.{name}: found something else than numbers")


def _check_comparison(content: Mapping[str, Any]) -> None:
    for key in ("policies", "paired"):
        _require_table(key, content[key])
    if not content["policies"]:
        raise ValueError("policies: found none")
    for name, row in content["policies"].items():
        if "reward" not in row:
            raise ValueError(f"policies.{name}.reward: found none")
    if "seed" not in content and "keys" not in content:
        raise ValueError("seed: found neither seed nor keys")
    selected(content)
    if "bound" in content:
        _require_table("bound.policies", content["bound"]["policies"])
    for name, run in content.get("training_seeds", {}).items():
        for what, figure in (("reward", run["reward"]), *run["minus"].items()):
            where = f"training_seeds.{name}.{what}"
            _require_table(where, {"seeds": figure["seeds"]})
            _require_table(where, {"": {k: figure[k] for k in ("mean", "interquartile_mean")}})
            _require_lists(f"{where}.profile", figure["profile"], "above", "share", "low", "high")
    if "position_errors" in content:
        _require_positions("position_errors", content["position_errors"])
    decisions = content.get("decisions", {})
    for kind in events(decisions):
        for name, band in decisions[kind]["error_minus_m"].items():
            lines = {**band, "time_s": decisions["time_s"]}
            where = f"decisions.{kind}.error_minus_m.{name}"
            _require_lists(where, lines, "time_s", "mean", "low", "high")


def _require_positions(key: str, found: Mapping[str, Any]) -> None:
    """Refuse errors without what tables show of them; what is not known is null."""
    if not is_number(found["risk"]):
        raise ValueError(f"{key}.risk: found {found['risk']!r:.60}, expected a number")
    for name, kinds in found["policies"].items():
        for kind, one in kinds.items():
            values = [
                *one["percentiles_m"].values(),
                *one["within_m"].values(),
                *(one["ci95"] or ()),
            ]
            for value in (*values, one["median_level_m"], one["share"]):
                if value is not None and not is_number(value):
                    where = f"{key}.{name}.{kind}"
                    raise ValueError(f"{where}: found {value!r:.60}, expected a number")


def selected(content: Mapping[str, Any]) -> Selection:
    """The episodes of a comparison."""
    if "keys" in content:
        return Selection(content["keys"], keyed=True)
    return Selection(range(content["seed"], content["seed"] + content["episodes"]))


def _check_track(content: Mapping[str, Any]) -> None:
    for key in ("epochs", "first_s", "last_s"):
        if not is_number(content[key]):
            raise ValueError(f"{key}: found {content[key]!r}, expected a number")
    for table, what in ((content["modes"].items(), "modes"), _seen(content["groups"])):
        for name, count in table:
            if not isinstance(count, int):
                raise ValueError(f"{what}.{name}: found {count!r}, expected a count")
    if "truth" in content:
        for row in content["truth"]["tracks"].values():
            row["ate_m"], row["in_bounds"]
        if "risk" in content["truth"]:
            rows = {name: kinds_of(row) for name, row in content["truth"]["tracks"].items()}
            _require_positions("truth", {**content["truth"], "policies": rows})


def _seen(groups: Mapping[str, Any]) -> tuple[list[tuple[str, Any]], str]:
    return [(name, group["seen"]) for name, group in groups.items()], "groups"


def _check_trust(content: Mapping[str, Any]) -> None:
    for kind in events(content["trust"]):
        one = content["trust"][kind]
        for name, row in one["error_m"].items():
            _require_epochs(f"{kind}.error_m.{name}", row, content["trust"]["time_s"])
        _require_epochs(f"{kind}.gain_m", one["gain_m"], content["trust"]["time_s"])
        for what in ("trusted", "probability"):
            times = {"time_s": content["trust"]["time_s"]}
            _require_lists(f"{kind}.{what}", one[what] | times, *one[what], "time_s")


def _require_epochs(key: str, row: Any, time_s: Any) -> None:
    """Refuse intervals that are not one to an epoch; means may be null."""
    if len(row) != len(time_s):
        raise ValueError(f"{key}: found {len(row)} epochs, expected {len(time_s)}")
    for one in row:
        if one["mean"] is not None:
            require_interval(key, one)


def events(around: Mapping[str, Any]) -> list[str]:
    """Kinds of events that figures stand around, beside their times."""
    return [kind for kind in around if kind != "time_s"]


def _check_defaults(content: Mapping[str, Any]) -> None:
    for number, row in enumerate(content["rows"]):
        row["library"], row["beliefs"], row["seconds"]
        _require_lists(f"rows.{number}", row, "each")
        for key in gains_of(row):
            require_interval(f"rows.{number}.{key}", row[key])


def gains_of(row: Mapping[str, Any]) -> list[str]:
    """Columns that say what was gained on somebody."""
    return [key for key in row if key.startswith("minus ")]


def _check_evolution(content: Mapping[str, Any]) -> None:
    tuning = content["tuning"]
    for key in gains_of(tuning):
        require_interval(f"tuning.{key}", tuning[key])
    tuning["seed"], tuning["episodes"]


class Kind(NamedTuple):
    """Results of one kind.

    Attributes:
        name: of the kind.
        needed: keys that it has, beside what says how it was made.
        optional: keys that it may have.
        check: refuses what can't be shown: ValueError, KeyError, TypeError or AttributeError.
        mark: a key that no other kind of the same command has.
    """

    name: str
    needed: tuple[str, ...]
    optional: tuple[str, ...] = ()
    check: Callable[[Mapping[str, Any]], None] = lambda content: None
    mark: str = ""


COMPARISON = Kind(
    "comparison", ("versions", "scenario", "radio", "episodes", "policies", "paired"),
    ("seed", "keys", "bound", "training_seeds", "decisions", "position_errors"),
    _check_comparison, "policies",
)  # fmt: skip
TRANSFER = Kind(
    "transfer", ("versions", "radio", "seed", "places"),
    check=lambda content: _require_table("places", content["places"]), mark="places",
)  # fmt: skip
TRACK = Kind(
    "localize",
    ("versions", "log", "scene", "radio", "epochs", "first_s", "last_s", "modes", "groups"),
    ("imm", "rule", "skipped", "restarts", "dropped", "speed_mps", "switches", "truth",
     "contradictions", "written", "error"),
    _check_track,
)  # fmt: skip
ENTRY = Kind("leaderboard", ("versions", "entry", "venues", "mean_gain"), check=require_entry)
RUN = Kind("run", ("hyperparameters",), ("modes", "banks", "seeds", "median"))
GAINS = Kind(
    "gains", ("versions", "title", "gains"),
    check=lambda content: _require_table(content["title"], content["gains"]),
)  # fmt: skip
TRUST = Kind("trust", ("versions", "title", "trust"), check=_check_trust, mark="time_s")
SWEEP = Kind(
    "sweep", ("versions", "cells", "failed", "sweep"),
    check=lambda content: _require_table("sweep", content["sweep"]), mark="sweep",
)  # fmt: skip
# Records of studies that are older than reports do not say their versions.
DEFAULTS = Kind(
    "defaults", ("steps", "seeds", "episodes", "rows"), ("versions",), _check_defaults, "rows",
)  # fmt: skip
EVOLUTION = Kind(
    "evolution",
    ("generations", "population", "episodes", "seconds", "tuning", "features", "weights", "bank"),
    ("versions",), _check_evolution, "weights",
)  # fmt: skip
