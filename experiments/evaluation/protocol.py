"""The benchmark's protocol: the sites (streets or recordings) at which contenders are judged.

Some sites are unseen in training. docs/benchmark.md explains the benchmark. An *entry* has a
contender's figures (rewards, errors, gains) at every site. The *clairvoyant* is a policy that knows
the truth. A score is a gain in reward over the paper's rule, in percent of the clairvoyant's gain.
*Hard* sites are streets with motion or receivers that no filter is designed for.
"""

import hashlib
import json
import math
import secrets
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtrit

from experiments.console.options import LeaderboardArgs, WorldArgs
from experiments.console.output import grid
from experiments.console.provenance import options_from
from experiments.evaluation.branches import CLAIRVOYANT
from experiments.evaluation.compare import score_cell, score_of
from experiments.evaluation.contenders import (
    BEST_IMM,
    RULE,
    contender_from,
    fingerprint,
    seeds_from,
    source_of,
)
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.runner import AllScores, score_contenders
from mmwave_env.datasets.samples import sample_names
from mmwave_env.io.files import Json, read_json
from mmwave_env.models.radio import RADIOS, TUNED_RADIOS
from mmwave_env.models.scene import SCENES, TRAINED_SCENES
from mmwave_env.numerics.numbers import Array
from mmwave_env.world.episode import Episode, EpisodeSource
from mmwave_env.world.keys import Keys
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import Trajectory

HERE = Path(__file__).parent
DURATION_S = 800  # duration of a trajectory, s; an episode is a random window of 200 s
STREET = SCENES["street"]


@dataclass(frozen=True)
class Misstated(SimulatedSource):
    """A source of episodes whose receiver misstates its noise by a constant factor."""

    stated: float = 1.0  # ratio of stated to true standard deviations

    def episodes(self, keys: Keys) -> list[Episode]:
        """Return the episodes that ``keys`` (n,) determine, with misstated noise."""
        episodes = super().episodes(keys)
        return [replace(episode, sigma=self.stated * episode.sigma) for episode in episodes]


def corners() -> Trajectory:
    """Return the path of a car at 10 m/s that turns at every crossing of the default scene."""
    crossings = np.array([(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (1, 2), (1, 1), (0, 1)])
    block_s = round(STREET.streets.block_m / 10.0)
    nodes = STREET.streets.block_m * np.resize(crossings, (DURATION_S // block_s + 1, 2))
    x, y = (np.interp(np.arange(DURATION_S), block_s * np.arange(len(nodes)), n) for n in nodes.T)
    return _trajectory("corners", x, y + STREET.streets.y_m[0])


def bus() -> Trajectory:
    """Return the path of a bus that goes back and forth and stops for 15 s every 300 m."""
    speed_mps = np.interp(np.arange(50), [0, 10, 25, 35], [0, 12, 12, 0])
    gone = np.cumsum(np.resize(speed_mps, DURATION_S)) % 600.0
    x = np.minimum(gone, 600.0 - gone) - 150.0
    return _trajectory("bus", x, np.zeros(len(x)))


def _trajectory(name: str, x: Array, y: Array) -> Trajectory:
    height_m = np.full(len(x), STREET.streets.height_m)
    return Trajectory(name, np.arange(len(x), dtype=float), np.stack([x, y, height_m], axis=1))


MakeSource = Callable[[], EpisodeSource]


def played_on(**options: Any) -> MakeSource:
    """Return a function that returns the source of episodes for options of ``compare``."""
    return partial(source_of, WorldArgs(**options))


HARD_SOURCES: dict[str, MakeSource] = {
    "corners:handset": lambda: SimulatedSource(STREET, RADIOS["handset"], corners()),
    "bus:standard": lambda: SimulatedSource(SCENES["dynamic-doppler"], RADIOS["standard"], bus()),
    "noise-twice:handset": lambda: Misstated(STREET, RADIOS["handset"], stated=0.5),
    "clock-offset:handset": played_on(clock="offset"),
    "surveyed-badly:handset": played_on(survey="bad"),
    "range-azimuth:handset": played_on(measurements=("range", "azimuth")),
}


TRAINED = "to train in"
UNSEEN_KIND = "unseen"
RECORDED = "recorded"
HARD = "hard"
KINDS = (TRAINED, UNSEEN_KIND, RECORDED, HARD)
IMMS = ("imm", BEST_IMM)
UNSEEN_SCENES = ("avenue", "plaza", "alley")
UNSEEN_RADIOS = ("tablet",)
UNSEEN = UNSEEN_SCENES + UNSEEN_RADIOS  # nothing is tuned or trained on them
OTHER_RADIOS = ("handset", "standard")  # radios for unseen streets and for recordings
# episodes at each simulated site, noise draws for each recording
EPISODES = 2000
DRAWS = 200
# a score uses at most so many episodes and draws
CEILING_EPISODES = 400
CEILING_DRAWS = 20
SHIPPED = HERE / "entries"  # folder of the published entries
BESIDE = (CLAIRVOYANT, "corrector", "guided", "imm-best")  # entries to show beside a user's entries


def name_or_file(name: str) -> str:
    """Return the name of a scene or radio or, if it is unseen, its JSON file."""
    return str(HERE / "unseen" / f"{name}.json") if name in UNSEEN else name


@dataclass(frozen=True)
class Site:
    """A site of the benchmark: a simulated street or a recording, with a radio."""

    name: str
    kind: str  # one of :data:`KINDS`
    radio: str  # name or file of the radio
    source: MakeSource  # function that returns the source of the site's episodes

    def scored(self, episodes: int) -> int:
        """Return how many of so many episodes, counted from the first, are used for a score."""
        return min(episodes, CEILING_DRAWS if self.kind == RECORDED else CEILING_EPISODES)


def sites() -> list[Site]:
    """Return all sites: training sites, unseen streets and radio, recordings, hard sites."""
    made = []
    for kind, scenes, radios in (
        (TRAINED, TRAINED_SCENES, TUNED_RADIOS),
        (UNSEEN_KIND, UNSEEN_SCENES, OTHER_RADIOS),
        (UNSEEN_KIND, ("street",), UNSEEN_RADIOS),
    ):
        for scene, radio in product(scenes, radios):
            file = name_or_file(radio)
            source = played_on(scene=name_or_file(scene), radio=file)
            made.append(Site(f"{scene}:{radio}", kind, file, source))
    for name, radio in product(sample_names(), OTHER_RADIOS):
        source = played_on(data=name, radio=radio)
        made.append(Site(f"{name}:{radio}", RECORDED, radio, source))
    for name, source in HARD_SOURCES.items():
        made.append(Site(name, HARD, name.split(":")[1], source))
    return made


def judge(names: Sequence[str], site: Site, episodes: int, seed: int) -> AllScores:
    """Run contenders, the paper's rule and every IMM at a site, on the same episodes."""
    # Modes of an unseen radio are untuned on purpose, so suppress the warning about untuned modes.
    with warnings.catch_warnings(action="ignore"):
        chosen = [contender_from(name, site.radio) for name in dict.fromkeys([*names, RULE, *IMMS])]
        return score_contenders(chosen, site.source(), seeds_from(episodes, seed))


def figures_of(name: str, site: Site, scores: AllScores) -> Json:
    """Return a contender's figures at a site: means, and gains over the rule and IMMs."""
    own = scores[name]
    rewards = own["reward"]
    gains = {imm: rewards - scores[imm]["reward"] for imm in IMMS if imm in scores and imm != name}
    first = slice(site.scored(len(rewards)))

    def mean(values: Array) -> Json:
        return bootstrap([values])[0].json

    return {
        "episodes": len(rewards),
        "reward": mean(rewards),
        "ate_m": mean(own["ate_m"]),
        "over_rule": mean(rewards[first] - scores[RULE]["reward"][first]),
        "minus": {imm: mean(gain) for imm, gain in gains.items()},
    }


def entry(name: str, judged: Mapping[Site, AllScores]) -> Json:
    """Return the entry of a contender: its figures at every site."""
    sites = {site.name: figures_of(name, site, scores) for site, scores in judged.items()}
    return {"entry": name, "policy": fingerprint(name), "sites": sites}


def sealed(content: Json) -> Json:
    """Return an entry that ends with its *seal*, the SHA-256 of everything in it."""
    rest = {**content}
    rest.pop("seal", None)
    text = json.dumps(rest, sort_keys=True)
    return rest | {"seal": hashlib.sha256(text.encode()).hexdigest()}


def read_entry(path: Path) -> Json:
    """Read an entry that :func:`entry` made and :func:`sealed` ended.

    Raises:
        ValueError: the entry is invalid, or was changed since the command wrote it; the message
            names the file and what is wrong in it.
    """

    def checked(content: Json) -> Json:
        if content != sealed(content):
            raise ValueError("seal: found content that mmwave-loc leaderboard did not write")
        tables_of({CLAIRVOYANT: content})  # raises if tables can't show the entry
        return content

    return read_json(path, "an entry", checked)


def entries_in(folder: Path) -> dict[str, Json]:
    """Return entries by name: those of :data:`BESIDE` that a folder lacks, then the folder's."""
    own = [read_entry(path) for path in sorted(folder.glob("*.json"))]
    entries = {entry["entry"]: entry for entry in own}
    missing = [name for name in BESIDE if name not in entries]
    return {name: read_entry(SHIPPED / f"{name}.json") for name in missing} | entries


def score_at(site: Site, content: Json, ceiling: Json) -> float | None:
    """Return the score of an entry at a site; ``ceiling`` is the entry of the clairvoyant.

    The score is None unless both were compared with the rule on the same episodes.
    """
    at = content["sites"][site.name]
    top = ceiling["sites"][site.name]
    if site.scored(at["episodes"]) != site.scored(top["episodes"]):
        return None
    return score_of(at["over_rule"]["mean"], top["over_rule"]["mean"])


def figures_at(content: Json, kind: str) -> list[Json]:
    """Return the figures of an entry at all sites of a kind."""
    return [content["sites"][site.name] for site in sites() if site.kind == kind]


def mean_gain(content: Json, kind: str) -> float:
    """Return an entry's gain over imm-best, the best classical method, at the sites of a kind."""
    even = {"mean": 0.0}  # of imm-best itself
    gains = (figures["minus"].get(BEST_IMM, even) for figures in figures_at(content, kind))
    return float(np.mean([gain["mean"] for gain in gains]))


def tables_of(entries: Mapping[str, Json]) -> str:
    """Return all tables of entries by name, which include the clairvoyant.

    The clairvoyant's own scores at the sites, which are all 100, are left out.
    """
    ceiling = entries[CLAIRVOYANT]
    judged = {name: content for name, content in entries.items() if name != CLAIRVOYANT}
    by_site = [
        [
            site.name,
            Interval.of(ceiling["sites"][site.name]["over_rule"]),
            *(score_cell(score_at(site, content, ceiling)) for content in judged.values()),
        ]
        for site in sites()
    ]
    gains = []
    scores = []
    for name, content in ranking([*entries.values()]):
        gains.append([name])
        scores.append([name])
        for kind in KINDS:
            stands = [standing(figures) for figures in figures_at(content, kind)]
            counts = " / ".join(str(stands.count(level)) for level in ("above", "level", "below"))
            gains[-1].append(f"{mean_gain(content, kind):.3f}, {counts}")
            each = [score_at(site, content, ceiling) for site in sites() if site.kind == kind]
            scores[-1].append(
                score_cell(None if None in each else float(np.mean(np.array(each, float))))
            )
    return (
        "Score at each site:\n\n"
        f"{grid(['site', f'{CLAIRVOYANT} minus {RULE}', *judged], by_site)}\n\n"
        "Mean gain over imm-best, counts of sites: above every other IMM / level / below one:\n\n"
        f"{grid(['entry', *KINDS], gains)}\n\n"
        "Mean score (100: the clairvoyant, 0: the paper's rule):\n\n"
        f"{grid(['entry', *(f'score {kind}' for kind in KINDS)], scores)}"
    )


def standing(figures: Json) -> str:
    """Return "above" if an entry beats every IMM at a site, "below" if an IMM beats the entry.

    Otherwise return "level". A difference counts only if its interval excludes 0.
    """
    intervals = [gain["ci95"] for gain in figures["minus"].values()]
    if all(low > 0.0 for low, _ in intervals):
        return "above"
    return "below" if any(high < 0.0 for _, high in intervals) else "level"


def ranking(entries: Sequence[Json]) -> list[tuple[str, Json]]:
    """Return entries with their names, ranked by their mean gain at the training sites.

    The protocol requires EPISODES at each simulated site and DRAWS of each recording; for the
    clairvoyant, CEILING_EPISODES and CEILING_DRAWS are enough. An entry with too few episodes or
    draws is marked and comes last, because luck would decide its rank.
    """
    ranked = []
    for content in entries:
        least = {
            kind: min(figures["episodes"] for figures in figures_at(content, kind))
            for kind in KINDS
        }
        recorded = least.pop(RECORDED)
        simulated = min(least.values())
        knows = content["entry"] == CLAIRVOYANT
        episodes, draws = (CEILING_EPISODES, CEILING_DRAWS) if knows else (EPISODES, DRAWS)
        short = simulated < episodes or recorded < draws
        name = content["entry"].removesuffix("/policy.safetensors")
        name += f" (too few: {simulated} / {recorded})" if short else ""
        ranked.append((short, -mean_gain(content, TRAINED), name, content))
    ranked.sort(key=lambda row: row[:2])
    return [(name, content) for *_, name, content in ranked]


# --- verification: an entry's policy plays again, at two sites that are chosen anew each time. It
# plays the claimed episodes, whose figures must be the same, and episodes of seeds that nobody
# could know before, whose figures must fit statistically.

PLAYED_AGAIN = 2  # number of sites at which an entry plays again
HIDDEN = 50  # number of episodes of unknown seeds at each of them
# first and last of the test seeds from which they are drawn; results are published on lower ones
HIDDEN_SEEDS = (1_000_000, 4_999_950)
# largest difference of figures on the same episodes, in widths of their interval: other
# processors round differently, which matters in the few episodes in which filters are lost
SAME = 0.1
SURELY = 4.5  # standard deviations that a mean of hidden episodes may differ from the claim
# if it is of many episodes; for few, the same quantile of Student's t distribution


def verify(path: Path) -> list[str]:
    """Verify the entry in a file; return what differs, or nothing.

    Raises:
        ValueError: the entry is invalid or was changed, or its policy can't be loaded.
        FileNotFoundError: there is no such file, or the policy's file is missing.
    """
    claimed = read_entry(path)
    policy = fingerprint(claimed["entry"])
    if policy != claimed["policy"]:
        return [
            f"policy: found the hash {policy}, expected {claimed['policy']}; the policy's file or "
            "module is not the one that was judged"
        ]
    differences = [
        f"{site.name}, {figure}: found {claim.mean}, expected a finite number"
        for site in sites()
        for figure, claim in _figures(claimed["sites"][site.name]).items()
        if not math.isfinite(claim.mean)
    ]
    for site in secrets.SystemRandom().sample(sites(), PLAYED_AGAIN):
        differences += _differences(claimed, site)
    return differences


def _differences(claimed: Json, site: Site) -> Iterator[str]:
    """Let the policy play at a site again; yield what differs from the entry."""
    name = claimed["entry"]
    stated = claimed["sites"][site.name]
    claims = _figures(stated)
    again = _played(name, site, stated["episodes"], options_from(LeaderboardArgs, claimed).seed)
    seed = secrets.choice(range(*HIDDEN_SEEDS))
    hidden = _played(name, site, HIDDEN, seed)
    surely = stdtrit(max(stated["episodes"] - 1, 1), ndtr(SURELY))
    for figure, same in again.items():
        claim = claims[figure]
        most = SAME * (same.high - same.low) + 1e-9
        if not (abs(np.subtract(claim, same)) <= most).all():
            yield f"{site.name}, {figure}: found {claim}, played {same}"
        other = hidden[figure]
        sigma = math.hypot(claim.high - claim.low, other.high - other.low) / (2.0 * 1.96)
        if not abs(claim.mean - other.mean) <= surely * sigma + 1e-9:
            yield (
                f"{site.name}, {figure}: found {claim.mean:.4f}, played {other.mean:.4f} on "
                f"{HIDDEN} episodes from seed {seed} on"
            )


def _played(name: str, site: Site, episodes: int, seed: int) -> dict[str, Interval]:
    return _figures(figures_of(name, site, judge([name], site, episodes, seed)))


def _figures(stated: Json) -> dict[str, Interval]:
    """Return the figures at a site: reward, ATE, and gains over the rule (scores) and the IMMs."""
    named = {figure: stated[figure] for figure in ("reward", "ate_m", "over_rule")}
    named |= {f"minus {imm}": gain for imm, gain in stated["minus"].items()}
    return {figure: Interval.of(of) for figure, of in named.items()}
