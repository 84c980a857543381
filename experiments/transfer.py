"""mmwave-loc transfer: switchers on streets, radios and recordings they were not trained on."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.arguments.shared import EpisodeArgs
from experiments.arguments.transfer import Args
from experiments.cli.main import run
from experiments.cli.options import contender_of, provenance, selection_of, source_of
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.intervals import Interval, bootstrap
from experiments.evaluation.markdown import grid, show
from experiments.evaluation.protocol import RECORDINGS
from experiments.evaluation.runner import score
from experiments.evaluation.runs import Run
from experiments.evaluation.terminal import tracked
from mmwave_env.files import write_json
from mmwave_env.models.radio import RADIOS, radio_from
from mmwave_env.models.scene import SCENES

TRANSFER_RIVALS = ("speed-rule", "imm", "imm-robust")


def places(args: Args) -> dict[str, EpisodeArgs]:
    """The street of the training, other streets, other radios, recordings, by name."""
    radio, seed = args.radio, args.seed
    simulated = [
        ("street", radio),
        *((scene, radio) for scene in SCENES if scene != "street"),
        *(("street", other) for other in RADIOS if other != radio),
    ]
    streets = {
        f"{scene}, {heard}": EpisodeArgs(
            scene=scene, radio=heard, episodes=args.episodes, seed=seed
        )
        for scene, heard in simulated
    }
    return streets | {
        f"{name}, {radio}": EpisodeArgs(data=name, radio=radio, episodes=args.draws, seed=seed)
        for name in RECORDINGS
    }


def compared(place: EpisodeArgs, policies: list[Contender]) -> dict[str, Interval]:
    """Reward of every policy, and what it gains on each rival of the place's radio, by name."""
    source, policies = source_of(place), [one.at(place.radio) for one in policies]
    episodes = selection_of(place, source).draw(source)
    rivals = [contender_of(place, name) for name in TRANSFER_RIVALS]
    reward = {
        one.name: score(one, one.start(source.layout), episodes)["reward"]
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
    policies = [_policy(name, radio_from(args.radio).name) for name in args.policies]
    there = places(args)
    found = {
        name: compared(place, policies)
        for name, place in tracked(there.items(), "transfer", len(there))
    }
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
        write_json(args.json, provenance("transfer", args) | content)


if __name__ == "__main__":
    run("transfer")
