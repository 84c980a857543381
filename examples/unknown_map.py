"""The benchmark's site without a map (docs/benchmark.md): localize by paths and a base station.

``PYTHONPATH=. python examples/unknown_map.py`` judges :func:`learned`. Your own entry is
``my_module:function`` with the same arguments and result.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib import import_module
from pathlib import Path

import numpy as np

from experiments.console.output import grid
from experiments.evaluation.intervals import bootstrap_ratio, rounded
from mmwave_env.datasets.log_folder import log_text, path_columns
from mmwave_env.filters.bank import default_modes
from mmwave_env.io.files import write_json
from mmwave_env.localization.image_filter import Paths
from mmwave_env.localization.map_learning import MapLearner
from mmwave_env.logs.log import read_paths
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, read_scene, scene_json
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode
from mmwave_env.world.keys import keys_of
from mmwave_env.world.simulated import SimulatedSource

STREET = SCENES["street"]
FALSE_PATHS = 1.0  # mean number per epoch
SETTLED_S = 30.0  # errors count from this time on
MISSING_M = 10.0  # error of an epoch without a position

Entry = Callable[[Path, Path, str], Array]


def learned(log: Path, scene: Path, radio: str) -> Array:
    """Localize a user by paths while learning the map; this is what an entry does.

    Args:
        log: CSV file with a row for each path, as ``localize --map learn`` reads it. An epoch must
            not use later rows than those of the ten next epochs.
        scene: JSON file with the position of the base station, carrier and bandwidth.
        radio: name of the radio, "standard" or "handset".

    Returns:
        Rows (n, 4) of times (s) and positions (m), one for each epoch with a position.
    """
    learner = MapLearner(read_scene(scene), RADIOS[radio], default_modes(radio)[-1])
    return followed(learner, observed(learner, log, scene))


def observed(learner: MapLearner, log: Path, scene: Path) -> Iterator[Paths]:
    """Yield the paths of each epoch of a log."""
    return learner.observed(read_paths(log, read_scene(scene)))


def followed(learner: MapLearner, epochs: Iterable[Paths]) -> Array:
    """Return times and positions as :func:`learned` does."""
    rows = [[b.time_s, *b.x[:3]] for b in learner.follow(epochs) if b.tracked]
    return np.reshape(rows, (-1, 4))


def by_sight(log: Path, scene: Path, radio: str, episode: Episode) -> Array:
    """Localize a user as :func:`learned` does, by the true line of sight alone."""
    learner = MapLearner(read_scene(scene), RADIOS[radio], default_modes(radio)[-1])
    epochs = []
    for paths in observed(learner, log, scene):
        (t,) = np.flatnonzero(episode.time_s == paths.time_s)
        epochs.append(paths.part(np.isclose(paths.z[:, 0], episode.measurement[t, 0])))
    return followed(learner, epochs)


def error_m(rows: Array, episode: Episode, times: Array) -> float:
    """Return the mean error (m) of the rows of an entry at these times."""
    scored = rows[np.isin(rows[:, 0], times)]
    true = episode.truth_position_m[np.searchsorted(episode.time_s, scored[:, 0])]
    missing = np.setdiff1d(times, scored[:, 0])
    errors = np.linalg.norm(scored[:, 1:] - true, axis=1)
    return float(np.append(errors, np.full(len(missing), MISSING_M)).mean())


def errors_m(entry: Entry, radio: str, seed: int) -> list[float]:
    """Return mean errors of the line of sight alone, of an entry, and with the true images."""
    source = SimulatedSource(STREET, RADIOS[radio])
    episode = source.episode(int(keys_of([seed])[0]))
    columns = path_columns(episode, FALSE_PATHS, np.random.default_rng(seed))
    times = np.unique(columns["time_s"])
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "log.csv")
        station = Path(folder, "base-station.json")
        street = Path(folder, "street.json")
        log.write_text(log_text(columns))
        write_json(station, scene_json(STREET.with_anchors(STREET.anchors_m[:1])))
        write_json(street, scene_json(STREET))
        rivals = [
            by_sight(log, station, radio, episode),
            np.reshape(entry(log, station, radio), (-1, 4)),
            learned(log, street, radio),
        ]
    return [error_m(rows, episode, times[times >= SETTLED_S]) for rows in rivals]


def row(entry: Entry, radio: str, seeds: range) -> list[object]:
    """Return a row of the table: errors, and the score with its interval over episodes."""
    errors = np.array([errors_m(entry, radio, seed) for seed in seeds])
    sight, own, known = errors.T
    (score,) = bootstrap_ratio([100.0 * (sight - own)], [sight - known])
    return [radio, *(f"{mean:.3f}" for mean in errors.mean(axis=0)), rounded(score)]


def main(words: Sequence[str] | None = None) -> None:
    """Judge an entry, and print a table; ``words`` are the arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("entry", nargs="?", help="module:function; by default, MapLearner")
    parser.add_argument("--episodes", type=int, default=100, help="number, at least 2")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode")
    args = parser.parse_args(words)
    entry: Entry = learned
    if args.entry:
        module, _, name = args.entry.partition(":")
        entry = getattr(import_module(module), name)
    seeds = range(args.seed, args.seed + args.episodes)
    header = ["radio", "line of sight alone m", "entry m", "true images m", "score"]
    print(grid(header, [row(entry, radio, seeds) for radio in ("standard", "handset")]))


if __name__ == "__main__":
    main()
