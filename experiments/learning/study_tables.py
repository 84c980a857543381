"""What the studies of beliefs per mode came to, on test seeds: tables of docs/learning.md."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from experiments.evaluation.contenders import BEST_IMM, Contender, contender_from
from experiments.evaluation.intervals import over_seeds_and_episodes
from experiments.evaluation.markdown import grid
from experiments.evaluation.runner import score
from experiments.evaluation.runs import Run
from experiments.evaluation.seeds import TUNING_SEED, draw_episodes
from experiments.learning.continuous_trust import Trust, TrustEngine, mean_factor, mean_trust
from experiments.learning.defaults import defaults_table
from experiments.learning.evolution import TUNING_EPISODES, LinearTrust
from experiments.learning.studies import DEFAULTS, EVOLUTION, TRAININGS, record_of
from experiments.training.places import Place
from mmwave_env.episodes.episode import Episode
from mmwave_env.files import read_json
from mmwave_env.filters.bank import Bank
from mmwave_env.numerics.arrays import Array
from policies import LearnedSwitch

RADIO = "handset"
GUIDED = "guided"


class Venue(NamedTuple):
    """Where the rows of a table are judged."""

    scene: str
    tuning: bool = False  # on tuning episodes, which choices were made by

    @property
    def name(self) -> str:
        """As in headers."""
        return f"{self.scene}, {'tuning' if self.tuning else 'test'} seeds"


class Study(NamedTuple):
    """A table."""

    reference: str  # row that the others are compared with
    rows: tuple[str, ...]
    venues: tuple[Venue, ...] = (Venue("street"),)


BANKS = tuple(name for name, training in TRAININGS.items() if training.without)
STUDIES: Mapping[str, Study] = {
    "beliefs": Study("shared", ("shared", "ppo")),
    "algorithms": Study("ppo", ("ppo", "branch")),
    "places": Study(
        "branch",
        ("branch", "many-places", "random-streets"),
        tuple(map(Venue, ("street", "o1", "dynamic-doppler"))),
    ),
    "modes": Study("branch", ("branch", *(row for name in BANKS for row in (f"imm {name}", name)))),
    "trust": Study(GUIDED, (GUIDED, f"{GUIDED}, mean trust", f"{GUIDED}, mean factor")),
    "evolution": Study(
        GUIDED, (GUIDED, "branch", EVOLUTION), (Venue("street", tuning=True), Venue("street"))
    ),
}


class Row(NamedTuple):
    """Something that is judged, after so much training."""

    rewards: Callable[[Sequence[Episode]], Array]  # (trainings, episodes) on some episodes
    seeds: str = ""
    trained: str = ""


def rows_of(runs: Path) -> dict[str, Row]:
    """All rows that are recorded, by name.

    Args:
        runs: folder of the recorded runs.
    """
    found = {BEST_IMM: Row(partial(_rewards_of, [contender_from(BEST_IMM, RADIO)]))}
    studies = runs / "studies"
    for name in [name for name in TRAININGS if record_of(studies, name).is_file()]:
        run = Run.read(str(studies / name))
        found[name] = _row_of(run, run.policies, str(len(run.seeds)))
        if name in BANKS:
            bank = LearnedSwitch(Path(run.policy)).bank(RADIO)
            imm = Contender(name, bank.modes, None, bank.transition, bank.nis_quantile)
            found[f"imm {name}"] = Row(partial(_rewards_of, [imm]))
    guided = Run.read(str(runs / GUIDED))
    found[GUIDED] = _row_of(guided, [guided.policy], f"median of {len(guided.seeds)}")
    switch = LearnedSwitch(Path(guided.policy))
    for how, trust in (("trust", mean_trust(switch)), ("factor", mean_factor(switch))):
        rewards = partial(_rewards_with, trust, switch.bank(RADIO))
        found[f"{GUIDED}, mean {how}"] = found[GUIDED]._replace(rewards=rewards)
    if (record := record_of(studies, EVOLUTION)).is_file():
        evolved = read_json(record, "the record of a study", dict)
        linear = LinearTrust.of(evolved)
        rewards = partial(_rewards_with, linear, linear.bank)
        found[EVOLUTION] = Row(rewards, "1", f"{evolved['seconds']:.0f} s")
    return found


def _row_of(run: Run, policies: list[str], seeds: str) -> Row:
    """The row of some policies of a run."""
    contenders = [Contender.learned(Path(file), radio=RADIO) for file in policies]
    seconds = median(outcome["seconds"] for outcome in run.outcomes)
    counted = "states" if LearnedSwitch(Path(policies[0])).card.algorithm == "branch" else "steps"
    trained = f"{seconds:.0f} s, {run.outcomes[0]['timesteps']:,} {counted}"
    return Row(partial(_rewards_of, contenders), seeds, trained)


def _rewards_of(contenders: Sequence[Contender], episodes: Sequence[Episode]) -> Array:
    """Rewards (contenders, episodes)."""
    layout = episodes[0].layout
    return np.stack([score(one, one.start(layout), episodes)["reward"] for one in contenders])


def _rewards_with(trust: Trust, bank: Bank, episodes: Sequence[Episode]) -> Array:
    """Rewards (1, episodes) of continuous trust."""
    return TrustEngine(bank, episodes[0].layout, len(episodes)).run(episodes, trust)[None]


def study_tables(runs: Path, episodes: int, seed: int) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Title, Markdown and JSON of every study; its rows are those that are recorded.

    Args:
        runs: folder of the recorded runs.
        episodes: how many, on test seeds.
        seed: of the first.
    """
    rows = rows_of(runs)
    judged = _Judged(rows, episodes, seed)
    for title, study in STUDIES.items():
        rivals = [rival for rival in (BEST_IMM, study.reference) if rival in rows]
        columns = {f"{v.name}: minus {rival}": (v, rival) for v in study.venues for rival in rivals}
        lines, content = [], {}
        for name in [name for name in study.rows if name in rows]:
            gains = {
                column: over_seeds_and_episodes(
                    judged.rewards(venue, name) - judged.rewards(venue, rival)
                )
                for column, (venue, rival) in columns.items()
                if rival != name
            }
            cells = [str(gains[column]) if column in gains else "" for column in columns]
            lines.append([name, rows[name].seeds, rows[name].trained, *cells])
            content[name] = {what: gain.json for what, gain in gains.items()}
        yield title, grid(["", "seeds", "trained for", *columns], lines), content
    if (record := record_of(runs / "studies", DEFAULTS)).is_file():
        found = read_json(record, "the record of a study", dict)
        yield DEFAULTS, defaults_table(found), found


class _Judged:
    """Rewards of rows at venues, each found once."""

    def __init__(self, rows: Mapping[str, Row], episodes: int, seed: int) -> None:
        self._rows, self._test = rows, range(seed, seed + episodes)
        self._episodes: dict[Venue, list[Episode]] = {}
        self._rewards: dict[tuple[Venue, str], Array] = {}

    def rewards(self, venue: Venue, name: str) -> Array:
        """Of a row (trainings, episodes)."""
        if venue not in self._episodes:
            tuning = range(TUNING_SEED, TUNING_SEED + TUNING_EPISODES)
            seeds = tuning if venue.tuning else self._test
            source = Place(venue.scene, RADIO).source("mixed")
            self._episodes[venue] = draw_episodes(source, seeds)
        if (venue, name) not in self._rewards:
            self._rewards[venue, name] = self._rows[name].rewards(self._episodes[venue])
        return self._rewards[venue, name]
