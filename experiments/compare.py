"""mmwave-loc compare: several policies on the same episodes, with paired differences."""

from experiments.console.options import CompareArgs as Args


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.output import show
    from experiments.console.provenance import provenance
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
    _, text, content, epochs = results(args)
    if args.json:  # before show(), which fails if the program that reads its output stops
        write_json(args.json, provenance("compare", args) | content)
    show(text)  # also if a picture fails
    if args.errors:
        draw_error_cdf(epochs.errors_m, args.errors)
    if args.consistency:
        axes = 2 if args.planar else 3
        draw_consistency(epochs.time_s, epochs.nees, axes, args.consistency)
