"""mmwave-loc demo: the tables of docs/results.md, on simulated and on ray-traced streets."""

from dataclasses import dataclass
from pathlib import Path

from experiments.cli.main import run
from experiments.cli.options import EpisodeArgs
from experiments.cli.reporting import results
from experiments.evaluation.markdown import show
from mmwave_env.episodes.samples import sample_names
from mmwave_env.files import write_json, write_text

SHOWN = ("fixed-ekf", "fixed-ukf", "speed-rule", "imm-robust-limited", "ppo", "ppo-extended")


@dataclass
class Args:
    """Compare every policy on `mixed` and on the shipped ray-traced scenarios.

    Six of them are printed; the files have all of them, and every paired difference.
    """

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
        result, text, content = results(one, one.contenders())
        show(str(result.of(SHOWN)))
        tables.append(text)
        everything[result.scenario] = content
        write_json(args.out / f"{result.scenario}.json", content)
    write_text(args.out / "tables.md", "\n".join(tables))
    if args.json:
        write_json(args.json, everything)
    files = ", ".join(f"{args.out / scenario}.json" for scenario in everything)
    print(f"All {len(runs[0].contenders())} policies and all paired differences are in")
    print(f"{args.out / 'tables.md'}, with every figure in {files}.")
    print("README.md and docs/results.md say what the columns mean.")


if __name__ == "__main__":
    run("demo")
