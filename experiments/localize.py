"""mmwave-loc localize: the track of a log, from a learned policy, Algorithm 1 or an IMM."""

from dataclasses import dataclass

from experiments.console.options import LogArgs


@dataclass(kw_only=True)
class Args(LogArgs):
    """Compute the track of a measurement log, recorded or live.

    By default, a learned policy weighs several filters in every epoch. Two
    alternatives are the paper's Algorithm 1 (EKF up to 2 m/s, UKF above) and an
    IMM, which weighs the filters by itself.

        mmwave-loc localize log.csv --scene scene.json --out track.tum track.gpx
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
