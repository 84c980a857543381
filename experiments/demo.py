"""mmwave-loc demo: the README's tables, on simulated and on ray-traced streets."""

from dataclasses import dataclass
from pathlib import Path

from experiments.cli.main import run
from experiments.cli.options import EpisodeArgs
from experiments.cli.reporting import report
from experiments.evaluation.markdown import markdown
from mmwave_env.episodes.samples import sample_names
from mmwave_env.files import write_json, write_text


@dataclass
class Args:
    """Compare every policy on `mixed` and on the shipped ray-traced scenarios."""

    episodes: int = 1000
    """simulated episodes"""
    draws: int = 200
    """draws of receiver noise on each ray-traced scenario"""
    out: Path = Path("results")
    """folder for tables.md and one JSON file a comparison"""
    json: Path | None = None
    """write all comparisons to one file, too"""


def main(args: Args) -> None:
    """Run the command."""
    runs = [EpisodeArgs(episodes=args.episodes)]
    runs += [EpisodeArgs(data=name, episodes=args.draws) for name in sample_names()]
    tables, everything = [], {}
    for one in runs:
        result = report(one, one.contenders())
        tables.append(markdown(result))
        everything[result.scenario] = result.json
        write_json(args.out / f"{result.scenario}.json", result.json)
    write_text(args.out / "tables.md", "\n".join(tables))
    if args.json:
        write_json(args.json, everything)
    print(f"written to {args.out}/")


if __name__ == "__main__":
    run("demo")
