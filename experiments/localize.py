"""mmwave-loc localize: the track of a log, from a learned policy, Algorithm 1 or an IMM."""

from experiments.console.options import LogArgs as Args


def main(args: Args) -> None:
    """Run the command."""
    if args.live:
        from experiments.reporting.live import run_live

        return run_live(args)
    from experiments.reporting.log_results import localized

    return localized(args)
