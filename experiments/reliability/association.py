"""mmwave-loc association: what a track loses where nobody says which path is which anchor's.

Every episode is written twice, as a log with anchors and as one of paths with false ones among
them, and both are localized alike.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from experiments.cli.main import run
from experiments.cli.options import provenance
from experiments.evaluation.contenders import BEST_IMM, imm_banks
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.seeds import draw_episodes
from experiments.evaluation.terminal import progress
from experiments.reliability.arguments.association import Args
from mmwave_env.episodes.episode import Episode
from mmwave_env.episodes.log_folder import read_log_folder
from mmwave_env.episodes.log_writer import write_log
from mmwave_env.episodes.samples import log_names, sample_folder
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import write_json
from mmwave_env.filters.mode_files import modes_from
from mmwave_env.localization.association import Association, associate
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.logs.path_log import read_paths
from mmwave_env.models.radio import RADIOS, Radio
from mmwave_env.models.scene import Scene, scene_from
from mmwave_env.numerics.arrays import Array
from policies.speed_rule import by_predicted_speed

USERS, PROFILES, LOGS_RADIO = ("pedestrian", "vehicle"), ("handset", "standard"), "standard"
LOG_REPEATS = 10  # of a shipped log, at most, each with other false paths


class Outcome(NamedTuple):
    """An episode with its labels, and without."""

    # labelled_ate_m, hidden_ate_m: of the filtered tracks, over epochs that both have
    labelled_ate_m: float
    hidden_ate_m: float
    epochs: int
    wrong_epochs: int  # in which an anchor was given a path that is not its own
    untracked_epochs: int  # of those that the track with labels has
    links: int  # paths of anchors
    found_links: int  # those of them that were given to their anchor
    wrong_links: int  # paths that were given to another anchor than theirs


class Case(NamedTuple):
    """Episodes of one kind."""

    name: str
    radio: Radio
    scene: Scene
    episodes: list[Episode]


def cases(args: Args) -> Iterator[Case]:
    """The shipped logs, and every kind of user and radio."""
    radio = RADIOS[LOGS_RADIO]
    for name in log_names():
        track = read_log_folder(sample_folder(name))
        episode = track.episode(radio, np.random.default_rng(args.seed))
        yield Case(name, radio, track.scene, [episode] * min(args.episodes, LOG_REPEATS))
    scene, seeds = scene_from("street"), range(args.seed, args.seed + args.episodes)
    for user, profile in product(USERS, PROFILES):
        source = SimulatedSource(scene, RADIOS[profile], user)
        yield Case(f"{user}, {profile}", RADIOS[profile], scene, draw_episodes(source, seeds))


def outcome(case: Case, episode: Episode, args: Args, seed: int, folder: Path) -> Outcome:
    """Localize an episode with labels and without."""
    labelled, hidden = folder / "labelled.csv", folder / "hidden.csv"
    write_log(labelled, episode)
    write_log(hidden, episode, False, args.false_paths, seed)
    true = LogBlock.joined(list(read_log(labelled, case.scene)))
    fast = modes_from(None, case.radio.name)[-1]
    paths, tally = read_paths(hidden, case.scene), Association(len(case.scene.anchors_m))
    found = LogBlock.joined(list(associate(paths, case.scene, case.radio, fast, tally)))
    anchors = true.layout.anchors
    given, there = found.visible[:, :anchors], true.visible[:, :anchors]
    rows = np.stack([found.measurement, true.measurement])[..., : 4 * anchors]
    same = (rows[0] == rows[1]).reshape(-1, anchors, 4).all(axis=2)
    wrong = given & ~(there & same)
    errors = np.stack([_errors(case, block, episode, args) for block in (true, found)])
    both = np.isfinite(errors).all(axis=0)
    return Outcome(
        labelled_ate_m=float(errors[0, both].mean()),
        hidden_ate_m=float(errors[1, both].mean()),
        epochs=len(true),
        wrong_epochs=int(wrong.any(axis=1).sum()),
        untracked_epochs=int((np.isfinite(errors[0]) & ~np.isfinite(errors[1])).sum()),
        links=int(there.sum()),
        found_links=int((given & there & same).sum()),
        wrong_links=int(wrong.sum()),
    )


def _errors(case: Case, block: LogBlock, episode: Episode, args: Args) -> Array:
    """Position errors (T,), m; NaN where there is no track."""
    bank = imm_banks(case.radio.name)[BEST_IMM]() if args.imm else None
    modes, rule = bank or modes_from(None, case.radio.name), None if bank else by_predicted_speed
    assert episode.truth_position_m is not None  # both kinds have one
    errors = np.full(len(episode), np.nan)
    for track in localize([block], case.scene, case.radio, modes, rule, window=None):
        at = np.searchsorted(episode.time_s, track.time_s)
        errors[at] = np.linalg.norm(track.x[:, :3] - episode.truth_position_m[at], axis=1)
    return errors


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Figures of one kind of episode."""
    columns = dict(zip(Outcome._fields, np.array(outcomes, float).T, strict=True))
    ates = np.column_stack([columns["labelled_ate_m"], columns["hidden_ate_m"]])
    ratios = columns["hidden_ate_m"] / columns["labelled_ate_m"]
    (difference,) = bootstrap((ates[:, 1] - ates[:, 0])[:, None])
    labelled, hidden = ates.mean(axis=0)
    epochs, links = columns["epochs"].sum(), columns["links"].sum()
    return {
        "episodes": len(outcomes),
        "labelled_ate_m": labelled,
        "hidden_ate_m": hidden,
        "ratio": hidden / labelled,
        "difference_m": difference.json,
        "median_ratio": float(np.median(ratios)),
        "episodes_within_10_percent": float((ratios <= 1.1).mean()),
        "wrong_epochs_share": columns["wrong_epochs"].sum() / epochs,
        "untracked_epochs_share": columns["untracked_epochs"].sum() / epochs,
        "found_links_share": columns["found_links"].sum() / links,
        "wrong_links_share": columns["wrong_links"].sum() / links,
    }


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The figures as Markdown."""
    header = [
        "log", "episodes", "ATE m with labels", "ATE m without", "ratio", "median ratio",
        "within 10 %", "epochs with a wrong path", "paths found", "epochs lost",
    ]  # fmt: skip
    percent = ("episodes_within_10_percent", "wrong_epochs_share", "found_links_share",
               "untracked_epochs_share")  # fmt: skip
    decimals = ("labelled_ate_m", "hidden_ate_m", "ratio", "median_ratio")
    return grid(
        header,
        [
            [name, str(f["episodes"]), *(f"{f[key]:.3f}" for key in decimals),
             *(f"{100.0 * f[key]:.2f} %" for key in percent)]
            for name, f in rows.items()
        ],
    )  # fmt: skip


def main(args: Args) -> None:
    """Run the command."""
    if args.episodes < 1:
        raise ValueError(f"episodes: found {args.episodes}, expected at least 1")
    kinds = len(log_names()) + len(USERS) * len(PROFILES)
    found: dict[str, list[Outcome]] = {}
    with TemporaryDirectory() as folder, progress("associating") as report:
        for number, case in enumerate(cases(args)):
            outcomes = found[case.name] = []
            for k, episode in enumerate(case.episodes):
                outcomes.append(outcome(case, episode, args, args.seed + k, Path(folder)))
                report((number + (k + 1) / len(case.episodes)) / kinds)
    rows = {name: summary(outcomes) for name, outcomes in found.items()}
    simulated = [one for name, some in found.items() if name not in log_names() for one in some]
    rows["all simulated"] = summary(simulated)
    if args.json:
        episodes = {name: [one._asdict() for one in some] for name, some in found.items()}
        write_json(
            args.json, provenance("association", args) | {"cases": rows, "episodes": episodes}
        )
    show(table(rows) + "\n")


if __name__ == "__main__":
    run("association")
