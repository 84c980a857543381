"""The benchmark's protocol: where everybody is judged, and what no training may see.

docs/benchmark.md explains it. An *entry* is a contender's figures in every place of the protocol.
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
# Of the published tables: recordings that come later are in docs/data.md.
EPISODES, DRAWS = 2000, 200  # on each simulated street, and on each recording
RECORDINGS = ("canyon28_pedestrian", "canyon28_vehicle")


def unseen_file(name: str) -> str:
    """The JSON file of an unseen scene or radio."""
    return str(files("experiments.evaluation").joinpath(f"unseen/{name}.json"))


@dataclass(frozen=True)
class Venue:
    """Where contenders are judged.

    Attributes:
        kind: one of :data:`KINDS`.
        scene: name or file; None for a recording.
        radio: name or file.
        data: a recording's name; None for a simulated street.
    """

    name: str
    kind: str
    scene: str | None
    radio: str
    data: str | None = None

    @property
    def source(self) -> EpisodeSource:
        """Where its episodes come from."""
        # What filters them is not asked, so that nobody is told that modes are not tuned.
        none = [Mode("none")]
        return task_from(scene=self.scene, radio=self.radio, episodes=self.data, modes=none).source


def venues() -> list[Venue]:
    """All there are: nine to train in, unseen streets and an unseen radio, recordings."""
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
    """Contenders in one venue.

    Attributes:
        venue: it.
        reward, ate_m: (episodes,) by contender.
        imms: names of the IMMs among them.
    """

    venue: Venue
    reward: dict[str, Array]
    ate_m: dict[str, Array]
    imms: tuple[str, ...]

    def figures(self, name: str) -> dict[str, Any]:
        """Of one contender, as an entry holds them: means, and what it gains on every IMM."""
        gains = {imm: self.reward[name] - self.reward[imm] for imm in self.imms if imm != name}
        columns = np.stack([self.reward[name], self.ate_m[name], *gains.values()], axis=1)
        reward, ate_m, *minus = (interval.json for interval in bootstrap(columns))
        return {
            "kind": self.venue.kind, "episodes": len(columns), "reward": reward, "ate_m": ate_m,
            "minus": dict(zip(gains, minus, strict=True)),
        }  # fmt: skip


def require_contenders(names: Sequence[str]) -> None:
    """Find out before any of them runs whether there is each of them in every venue.

    Raises:
        ValueError, FileNotFoundError: as of
            :func:`~experiments.evaluation.contenders.contender_from`.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as in judge
        for radio in dict.fromkeys(venue.radio for venue in venues()):
            for name in names:
                contender_from(name, radio)


def judge(names: Sequence[str], venue: Venue, episodes: int, seed: int) -> Judged:
    """Run contenders and every IMM in a venue, on the same episodes."""
    selection = Selection(range(seed, seed + episodes))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that no modes are tuned for an unseen radio is the point
        imms = [name for name in contenders(venue.radio) if name.startswith("imm")]
        chosen: list[Contender] = [
            contender_from(name, venue.radio) for name in dict.fromkeys([*names, *imms])
        ]
        scores = score_contenders(chosen, venue.source, venue.radio, selection)
    reward = {name: metrics["reward"] for name, metrics in scores.items()}
    ate = {name: metrics["ate_m"] for name, metrics in scores.items()}
    return Judged(venue, reward, ate, tuple(imms))


def entry(name: str, judged: Sequence[Judged]) -> dict[str, Any]:
    """The entry of a contender: its figures in every venue, and its mean gain a kind of venue."""
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
    """Over the best classical method, the IMM over the best bank; the mean over venues."""
    gains = [one.reward[name] - one.reward[BEST_IMM] for one in judged]
    (interval,) = bootstrap(np.mean(gains, axis=0)[:, None])
    return interval


def standing(figures: dict[str, Any]) -> str:
    """How an entry stands against every IMM in a venue: "above", "below" or "level"."""
    intervals = [gain["ci95"] for gain in figures["minus"].values()]
    if all(low > 0.0 for low, _ in intervals):
        return "above"
    return "below" if any(high < 0.0 for _, high in intervals) else "level"
