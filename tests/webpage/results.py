"""Results as commands write them, small, with names that others chose."""

import json
from pathlib import Path

from mmwave_env import __version__
from mmwave_env.metrics import METRICS

HOSTILE = "</script><img src=x onerror=alert(1)>$|`\n\x1b[31m\u202eΩ日本\"'&"
MADE = ("command", "versions")
VERSIONS = {"mmwave-loc": __version__, "python": "3.12.0"}


def interval(mean, half=0.1):
    """As results hold it."""
    return {"mean": mean, "ci95": [mean - half, mean + half]}


def metrics(mean):
    """One of every kind."""
    return {metric: interval(mean + i) for i, metric in enumerate(METRICS)}


def comparison(names=("imm", "speed-rule"), **more):
    """Of policies whose rewards are -1, -2, ..."""
    rows = {name: metrics(-1.0 - i) for i, name in enumerate(names)}
    first = next(iter(rows))
    pairs = {f"{name} - {first}": metrics(-0.5) for name in rows if name != first}
    return {
        "command": "mmwave-loc compare --policies imm speed-rule --episodes 2 --episode-steps 30",
        "versions": VERSIONS, "scenario": "mixed", "radio": "handset", "episodes": 2, "seed": 0,
        "policies": rows, "paired": pairs,
    } | more  # fmt: skip


def errors(**more):
    """Of one kind, as --percentiles writes them."""
    return {
        "epochs": 40, "percentiles_m": {"50": 0.5, "95": None}, "within_m": {"1": 0.75},
        "median_level_m": 2.5, "exceeded": 1, "share": 0.025, "ci95": [0.0, 0.15],
    } | more  # fmt: skip


def transfer():
    """Of one policy in two places."""
    row = {"ppo": interval(-1.25), "ppo minus imm": interval(0.375)}
    return {
        "command": "mmwave-loc transfer", "versions": VERSIONS, "radio": "handset", "seed": 0,
        "places": {"street, handset": row, HOSTILE: row},
    }  # fmt: skip


def learned():
    """Every kind of table of learned, small."""
    bare = {key: value for key, value in comparison(("ppo", "imm")).items() if key not in MADE}
    gains = {"branch": {"street, test seeds: minus imm": interval(0.25)}, HOSTILE: {}}
    around = {
        "events": 7, "trusted": {"none": [0.5, None], "stand": [0.5, 0.25]},
        "probability": {"stand": [0.5, 0.25]},
        "error_m": {"guided": [interval(1.0), interval(2.0)], "imm": [interval(3.0)] * 2},
        "gain_m": [interval(-2.0), {"mean": None, "ci95": None}],
    }  # fmt: skip
    return {
        "command": "mmwave-loc learned --episodes 20", "versions": VERSIONS,
        "trainings": {"docs/learning/ppo-handset": [outcome(0, -1.5)]}, "handset": bare,
        "trust, handset": {"time_s": [-1.0, 0.0], "stop": around},
        "transfer, handset": {"radio": "handset", "seed": 0, "places": transfer()["places"]},
        "ablations": {"as-shipped": {"reward": interval(-1.75)}}, "places": gains,
        "defaults": defaults(),
    }  # fmt: skip


def defaults(**more):
    """A record of studies, of agents of other libraries."""
    row = {"library": "CleanRL", "beliefs": "shared", "seconds": 12, "each": [-2.0, -1.5]}
    return {
        "command": "mmwave-loc studies --trainings defaults", "steps": 500, "seeds": 2,
        "episodes": 20, "rows": [row | {"minus imm": interval(-0.25)}],
    } | more  # fmt: skip


def track(**more):
    """Of a log."""
    group = {
        "seen": 40, "rejected": 2, "rejected_share": 0.05, "incomplete": 0, "nis_per_dof": 1.1,
        "nis_in_bounds": 0.94,
    }  # fmt: skip
    return {
        "command": "mmwave-loc localize log.csv --scene s.json", "versions": VERSIONS,
        "log": HOSTILE, "scene": "s", "radio": "handset", "imm": None, "rule": "of imm",
        "epochs": 40, "skipped": 0, "restarts": 0, "dropped": 0, "first_s": 0.0, "last_s": 39.0,
        "speed_mps": {}, "modes": {"ekf": 30, "ukf": 10}, "switches": 3,
        "groups": {"anchor 1": group}, "contradictions": [], "written": {}, "error": None,
    } | more  # fmt: skip


def outcome(seed, reward):
    """Of a training."""
    best = {
        "timesteps": 2000, "seed": 5_000_000, "episodes": 5, "reward": reward,
        "minus imm": interval(0.25),
    }  # fmt: skip
    return {"seed": seed, "timesteps": 4000, "seconds": 2.0, "beat_rule": None, "best": best}


def run(folder: Path, over=True):
    """A folder as train leaves it, in the middle or at the end."""
    manifest = {"command": "mmwave-loc train --seeds 2", "hyperparameters": {}, "modes": []}
    for seed in range(2):
        (folder / f"seed-{seed}").mkdir(parents=True)
        journal = (
            "timesteps,share/ekf,tuning/reward,tuning/minus imm\n1000,0.5,,\n2000,,-1.5,0.25\n"
        )
        (folder / f"seed-{seed}" / "progress.csv").write_text(journal)
    write(folder / "run.json", manifest)
    outcomes = [outcome(0, -1.5), outcome(1, -1.75)]
    for one in outcomes[: 2 if over else 1]:
        write(folder / f"seed-{one['seed']}" / "outcome.json", one)
    if over:
        write(folder / "summary.json", manifest | {"seeds": outcomes, "median": 1})
    return folder


def write(path: Path, content):
    """A JSON file."""
    path.write_text(json.dumps(content), encoding="utf-8")
    return path
