"""mmwave-loc evaluate: one policy, its metrics with 95 % intervals."""

from dataclasses import dataclass

from experiments.cli import run
from experiments.evaluation import compare, evaluate
from experiments.files import write_json
from experiments.options import EpisodeArgs
from experiments.tables import show


@dataclass
class Args(EpisodeArgs):
    """Evaluate one policy on seeded episodes."""

    policy: str = "speed-rule"
    """fixed-ekf, fixed-ukf, fixed-ckf, speed-rule, speed-rule-tuned, likelihood-rule, random or
    imm"""


def main(args: Args) -> None:
    """Run the command."""
    source = args.source()
    scores = evaluate([args.policy], source, args.radio, args.episodes, args.seed)
    result = compare(
        scores, scenario=source.name, radio=args.radio, episodes=args.episodes, seed=args.seed
    )
    show(result)
    if args.json:
        write_json(args.json, result.json)


if __name__ == "__main__":
    run("evaluate")
