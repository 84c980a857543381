"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from dataclasses import dataclass

from experiments.cli import run
from experiments.options import EpisodeArgs, report

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
    bound: bool = False
    """also show each policy's RMSE over the posterior Cramer-Rao bound"""


def main(args: Args) -> None:
    """Run the command."""
    report(args, args.policies, args.bound)


if __name__ == "__main__":
    run("compare")
