"""mmwave-loc localize: the track of a log, by a learned policy, Algorithm 1 or an IMM."""

from dataclasses import dataclass

from experiments.console.options import LogArgs


@dataclass(kw_only=True)
class Args(LogArgs):
    """The track of a measurement log, recorded or live.

    A learned policy weighs the filters of a bank in every epoch. Or the paper's Algorithm 1 runs:
    up to 2 m/s the EKF pipeline, above it the UKF pipeline. Or an IMM mixes a bank by itself.

    mmwave-loc localize log.csv --scene scene.json --out track.tum
    mmwave-loc localize log.csv --scene scene.json --speed auto --out track.tum
    mmwave-loc localize - --live --scene scene.json
    """


def main(args: Args) -> None:
    """Run the command."""
    if args.live:
        from experiments.reporting.live import run_live

        return run_live(args)
    from experiments.reporting.log_results import localized

    return localized(args)
