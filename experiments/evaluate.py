"""mmwave-loc evaluate: one policy, its metrics with 95 % intervals."""

from dataclasses import dataclass

from experiments.cli.main import run
from experiments.cli.options import EpisodeArgs
from experiments.cli.reporting import report, results


@dataclass
class Args(EpisodeArgs):
    """Evaluate one policy on seeded episodes."""

    policy: str = "speed-rule"
    """speed-rule, fixed-ekf, fixed-ukf, imm, ... (compare shows all there are), a policy file
    (.safetensors), the folder of a run, a model of Stable-Baselines3 (.zip, with --trust-zip), or
    module:function, a function without arguments that returns an agent"""


def main(args: Args) -> None:
    """Run the command."""
    report(args, results(args, [args.policy]))


if __name__ == "__main__":
    run("evaluate")
