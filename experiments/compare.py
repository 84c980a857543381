"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from experiments.console.options import EpisodeArgs


@dataclass(kw_only=True)
class Args(EpisodeArgs):
    """Compare policies on the same seeded episodes, with paired differences.

    All metrics, including the reward, leave out the first 10 epochs of an episode. Every policy is
    paired with the references: the best fixed mode, speed-rule, imm and imm-best. Your own agents
    and policy files (or all policies, if there is no reference) are paired with every other policy.

    mmwave-loc compare --policies fixed-ukf speed-rule imm ppo --episodes 200
    """

    policies: Annotated[tuple[str, ...], arg(aliases=("--policy",))] = ()
    """names from mmwave-loc list policies, policy files (.safetensors), folders of runs from
    mmwave-loc train, and module:function, a function without arguments that returns an agent; by
    default all policies that have a name, except clairvoyant, which knows the truth; beside
    speed-rule (0) and clairvoyant (100), policies have a score"""
    errors: Path | None = None
    """draw the distribution (CDF) of horizontal and of vertical errors to this .png, .svg or .pdf
    file"""
    consistency: Path | None = None
    """draw NEES over time, with its chi-square bounds, to this file"""


PICTURES = ("errors", "consistency")


def main(args: Args) -> None:
    """Run the command."""
    from experiments.evaluation.asked import all_contenders
    from experiments.reporting.comparison_results import report, results

    pictures = {name: getattr(args, name) for name in PICTURES if getattr(args, name) is not None}
    names = args.policies or all_contenders(args)
    report("compare", args, results(args, names, pictures))
