"""mmwave-loc transfer: switchers on streets, radios and recordings they were not trained on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.cli.main import run
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.runner import score
from experiments.evaluation.runs import Run
from experiments.evaluation.seeds import draw_episodes
from mmwave_env.episodes.episode import EpisodeSource
from mmwave_env.episodes.recorded import RecordedSource
from mmwave_env.episodes.samples import recording_from, sample_names
from mmwave_env.episodes.simulated import SimulatedSource
from mmwave_env.files import write_json
from mmwave_env.models.radio import RADIOS, radio_from
from mmwave_env.models.scene import SCENES, scene_from

TRANSFER_RIVALS = ("speed-rule", "imm", "imm-robust")


@dataclass
class Args:
    """Compare switchers, where they were trained and elsewhere, with what needs no training."""

    radio: str = "handset"
    """profile that the switchers were trained with: handset or standard"""
    policies: tuple[str, ...] = ("ppo", "ppo-extended")
    """shipped ones, policy files or folders of runs"""
    episodes: int = 500
    """on each simulated street"""
    draws: int = 100
    """of receiver noise on each recording"""
    seed: int = 0
    """seed of the first episode; test seeds start at 0"""
    json: Path | None = None
    """write every figure to this file"""


class Place(NamedTuple):
    """Where switchers are tried."""

    name: str  # in the table
    source: EpisodeSource  # of episodes
    radio: str  # profile, whose rivals they meet
    episodes: int  # how many


def places(args: Args) -> list[Place]:
    """The street of the training, other streets, other radios, recordings."""
    trained = radio_from(args.radio)
    found = [
        Place(f"{scene}, {radio}", SimulatedSource(scene_from(scene), radio_from(radio), "mixed"),
              radio, args.episodes)
        for scene, radio in [
            ("street", args.radio),
            *((scene, args.radio) for scene in SCENES if scene != "street"),
            *(("street", radio) for radio in RADIOS if radio != args.radio),
        ]
    ]  # fmt: skip
    recorded = [
        Place(f"{name}, {args.radio}", RecordedSource(recording_from(name), trained), args.radio,
              args.draws)
        for name in sample_names()
    ]  # fmt: skip
    return found + recorded


def compared(place: Place, policies: list[Contender], seed: int) -> dict[str, Interval]:
    """Reward of every policy, and what it gains on each rival, by name."""
    episodes = draw_episodes(place.source, range(seed, seed + place.episodes))
    rivals = [contender_from(name, place.radio) for name in TRANSFER_RIVALS]
    reward = {
        one.name: score(one, one.start(place.source.layout), episodes)["reward"]
        for one in (*policies, *rivals)
    }
    columns = {one.name: reward[one.name] for one in policies}
    for one in policies:
        columns |= {f"{one.name} minus {r}": reward[one.name] - reward[r] for r in TRANSFER_RIVALS}
    intervals = bootstrap(np.stack(list(columns.values()), axis=1))
    return dict(zip(columns, intervals, strict=True))


def _policy(name: str, radio: str) -> Contender:
    """A policy by name or file; the median one of a run."""
    folder = Path(name)
    if folder.is_dir():
        return Contender.learned(Run.read(name).policy, folder.name)
    return contender_from(name, radio)


def tried(args: Args) -> tuple[str, dict[str, Any]]:
    """The policies in every place, as Markdown and as JSON."""
    policies = [_policy(name, args.radio) for name in args.policies]
    found = {place.name: compared(place, policies, args.seed) for place in places(args)}
    columns = next(iter(found.values()))
    rows = [[place, *map(str, row.values())] for place, row in found.items()]
    figures = {
        place: {name: interval.json for name, interval in row.items()}
        for place, row in found.items()
    }
    content = {"radio": args.radio, "seed": args.seed, "places": figures}
    return grid(["street or recording, radio", *columns], rows), content


def main(args: Args) -> None:
    """Run the command."""
    text, content = tried(args)
    show(text)
    if args.json:
        write_json(args.json, content)


if __name__ == "__main__":
    run("transfer")
