"""mmwave-loc localize: the track of a recorded log, by the paper's Algorithm 1 or by an IMM."""

from dataclasses import dataclass

from experiments.console.options import LogArgs


@dataclass(kw_only=True)
class Args(LogArgs):
    """The track of a measurement log, by the paper's EKF and UKF pipelines (Algorithm 1).

    Up to 2 m/s the EKF pipeline runs, above it the UKF pipeline; or both, and more, in an IMM.

    mmwave-loc localize log.csv --scene scene.json --speed auto --out track.tum
    mmwave-loc localize log.csv --scene scene.json --imm imm-best --out track.tum
    """


def main(args: Args) -> None:
    """Run the command."""
    from experiments.reporting.log_results import localized

    localized(args)
