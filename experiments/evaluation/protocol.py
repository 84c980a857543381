"""The benchmark's protocol: the venues that judge contenders, some unseen in training.

docs/benchmark.md explains it. An *entry* holds a contender's figures in every venue.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from experiments.evaluation.contenders import BEST_IMM, Contender, contender_from, contenders
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.runner import score_contenders
from experiments.evaluation.seeds import Selection
from mmwave_env.filters.modes import Mode
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.task import task_from
from mmwave_env.world.episode import EpisodeSource

TRAINED, UNSEEN_KIND, RECORDED = KINDS = ("to train in", "unseen", "recorded")
UNSEEN_SCENES, UNSEEN_RADIOS = ("avenue", "plaza", "alley"), ("tablet",)
UNSEEN = UNSEEN_SCENES + UNSEEN_RADIOS  # nothing is tuned or trained on them
HEARD = ("handset", "standard")  # radios in unseen streets and on recordings
# Episodes and recordings of the published tables; docs/data.md lists later recordings.
EPISODES, DRAWS = 2000, 200  # in each simulated venue, and on each recording
RECORDINGS = ("canyon28_pedestrian", "canyon28_vehicle")


def unseen_file(name: str) -> str:
    """Return the JSON file of an unseen scene or radio."""
    return str(files("experiments.evaluation").joinpath(f"unseen/{name}.json"))


@dataclass(frozen=True)
class Venue:
    """A place of the benchmark: a simulated street or a recording, with a radio.

    Attributes:
        kind: kind of venue, from :data:`KINDS`.
        scene: name or file of the street; None for a recording.
        radio: name or file of the radio.
        data: a recording's name; None for a simulated street.
    """

    name: str
    kind: str
    scene: str | None
    radio: str
    data: str | None = None

    @property
    def source(self) -> EpisodeSource:
        """Return the source of the venue's episodes."""
        # A dummy mode, as filters do not matter here: it saves the warning about untuned modes.
        none = [Mode("none")]
        return task_from(scene=self.scene, radio=self.radio, episodes=self.data, modes=none).source


def venues() -> list[Venue]:
    """Return all venues: nine to train in, unseen streets and an unseen radio, recordings."""
    trained = [(scene, radio) for scene in SCENES for radio in RADIOS]
    found = [Venue(f"{scene}:{radio}", TRAINED, scene, radio) for scene, radio in trained]
    for name in UNSEEN_SCENES:
        file = unseen_file(name)
        found += [Venue(f"{name}:{radio}", UNSEEN_KIND, file, radio) for radio in HEARD]
    found += [
        Venue(f"street:{name}", UNSEEN_KIND, "street", unseen_file(name)) for name in UNSEEN_RADIOS
    ]
    return found + [
        Venue(f"{name}:{radio}", RECORDED, None, radio, name)
        for name in RECORDINGS
        for radio in HEARD
    ]


@dataclass(frozen=True)
class Judged:
    """Scores of contenders in one venue.

    Attributes:
        venue: place that they ran in.
        reward, ate_m: (episodes,) scores by contender.
        imms: names of the IMMs among the contenders.
    """

    venue: Venue
    reward: dict[str, Array]
    ate_m: dict[str, Array]
    imms: tuple[str, ...]

    def figures(self, name: str) -> dict[str, Any]:
        """Return a contender's part of an entry: means, and its gain over every IMM."""
        gains = {imm: self.reward[name] - self.reward[imm] for imm in self.imms if imm != name}
        columns = np.stack([self.reward[name], self.ate_m[name], *gains.values()], axis=1)
        reward, ate_m, *minus = (interval.json for interval in bootstrap(columns))
        return {
            "kind": self.venue.kind, "episodes": len(columns), "reward": reward, "ate_m": ate_m,
            "minus": dict(zip(gains, minus, strict=True)),
        }  # fmt: skip


def require_contenders(names: Sequence[str]) -> None:
    """Refuse, before any episode runs, contenders that some venue does not have.

    Raises:
        ValueError, FileNotFoundError: same as from
            :func:`~experiments.evaluation.contenders.contender_from`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # same as in judge
        for radio in dict.fromkeys(venue.radio for venue in venues()):
            for name in names:
                contender_from(name, radio)


def judge(names: Sequence[str], venue: Venue, episodes: int, seed: int) -> Judged:
    """Run contenders and every IMM in a venue, on the same episodes."""
    selection = Selection(range(seed, seed + episodes))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # modes are untuned for an unseen radio on purpose
        imms = [name for name in contenders(venue.radio) if name.startswith("imm")]
        chosen: list[Contender] = [
            contender_from(name, venue.radio) for name in dict.fromkeys([*names, *imms])
        ]
        scores = score_contenders(chosen, venue.source, venue.radio, selection)
    reward = {name: metrics["reward"] for name, metrics in scores.items()}
    ate = {name: metrics["ate_m"] for name, metrics in scores.items()}
    return Judged(venue, reward, ate, tuple(imms))


def entry(name: str, judged: Sequence[Judged]) -> dict[str, Any]:
    """Return the entry of a contender: figures of every venue, and mean gain per kind of venue."""
    return {
        "entry": name,
        "venues": {one.venue.name: one.figures(name) for one in judged},
        "mean_gain": {
            kind: _mean_gain(name, [one for one in judged if one.venue.kind == kind]).json
            for kind in KINDS
            if any(one.venue.kind == kind for one in judged)
        },
    }


def _mean_gain(name: str, judged: Sequence[Judged]) -> Interval:
    """Return the gain over the best classical method, imm-best, averaged over venues."""
    gains = [one.reward[name] - one.reward[BEST_IMM] for one in judged]
    (interval,) = bootstrap(np.mean(gains, axis=0)[:, None])
    return interval


def standing(figures: dict[str, Any]) -> str:
    """Return whether an entry is "above" every IMM in a venue, "below" one, or "level"."""
    intervals = [gain["ci95"] for gain in figures["minus"].values()]
    if all(low > 0.0 for low, _ in intervals):
        return "above"
    return "below" if any(high < 0.0 for _, high in intervals) else "level"
