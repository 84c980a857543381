"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from dataclasses import dataclass

from experiments.cli import run
from experiments.evaluation import compare, evaluate
from experiments.files import write_json
from experiments.options import EpisodeArgs
from experiments.tables import show

DEFAULT = (
    "fixed-ekf", "fixed-ukf", "fixed-ckf", "speed-rule", "speed-rule-tuned", "likelihood-rule",
    "random", "imm",
)  # fmt: skip


@dataclass
class Args(EpisodeArgs):
    """Compare policies on the same seeded episodes."""

    policies: tuple[str, ...] = DEFAULT
    """two or more of fixed-ekf, fixed-ukf, fixed-ckf, speed-rule, speed-rule-tuned,
    likelihood-rule, random, imm"""


def main(args: Args) -> None:
    """Run the command."""
    source = args.source()
    scores = evaluate(args.policies, source, args.radio, args.episodes, args.seed)
    result = compare(
        scores, scenario=source.name, radio=args.radio, episodes=args.episodes, seed=args.seed
    )
    show(result)
    if args.json:
        write_json(args.json, result.json)


if __name__ == "__main__":
    run("compare")
