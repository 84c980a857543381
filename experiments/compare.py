"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from dataclasses import dataclass
from pathlib import Path

from experiments.console.options import EpisodeArgs


@dataclass(kw_only=True)
class Args(EpisodeArgs):
    """Compare policies on the same seeded episodes, with paired differences.

    Differences are paired, episode by episode. All metrics, including the reward,
    leave out the first 10 epochs of an episode. Every policy is paired with the
    references (best fixed mode, speed-rule, imm, imm-best). Your own agents and
    policy files are paired with all others. If no policy is a reference, all pairs
    are compared.

        mmwave-loc compare --policies fixed-ukf speed-rule imm ppo --episodes 200
    """

    policies: tuple[str, ...] = ()
    """fixed-NAME (a mode in every epoch: fixed-ekf, fixed-ukf
    or fixed-ckf); speed-rule (the paper's rule: EKF up to
    2 m/s, UKF above); likelihood-rule (the mode that
    explains the coming measurement best); imm (interacting
    multiple models: mixes all modes) and imm-best (of five
    tuned modes); the learned ppo, guided, guided-ppo and
    corrector; policy files (.safetensors); folders of runs
    from `mmwave-loc train`; and module:function, a function
    without arguments that returns an agent. By default, all
    of these names run, but not clairvoyant, which knows the
    truth. If speed-rule (score 0) and clairvoyant (score
    100) both run, all policies get a score"""
    errors: Path | None = None
    """draw the distribution (CDF) of horizontal and of
    vertical errors to this .png, .svg or .pdf file"""
    consistency: Path | None = None
    """draw NEES over time, with its chi-square bounds, to this file"""


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import show
    from experiments.console.provenance import provenance
    from experiments.evaluation.contenders import all_contenders
    from experiments.reporting.comparison_results import results
    from experiments.reporting.figures import (
        draw_consistency,
        draw_error_cdf,
        require_picture,
    )
    from mmwave_env.io.files import write_json

    pictures = {"errors": args.errors, "consistency": args.consistency}
    for option, path in pictures.items():
        if path:
            require_picture(option, path)
    if args.errors and args.errors == args.consistency:
        expected = "a file other than the --errors file"
        raise ValueError(f"consistency: found {args.consistency}, expected {expected}")
    names = args.policies or all_contenders(args)
    made = results(args, names, with_epochs=any(pictures.values()))
    if args.json:  # before show(), which fails if the program that reads its output stops
        write_json(args.json, provenance("compare", args) | made.json)
    epochs = made.epochs
    show(made.text)  # also if a picture fails
    if args.errors:
        draw_error_cdf(epochs.errors_m, args.errors)
    if args.consistency:
        axes = 2 if args.planar else 3
        draw_consistency(epochs.time_s, epochs.nees, axes, args.consistency)
