"""Banks before they are tuned, each of them with other parts."""

from dataclasses import dataclass, replace

from mmwave_env.filters.modes import Mode


def _mode(name: str, algorithm: str, sigma_v: float, acceleration_mps2: float = 0.0) -> Mode:
    """A mode that doubts outliers instead of rejecting them."""
    return Mode(
        name, algorithm, sigma_p=0.01, sigma_v=sigma_v, acceleration_mps2=acceleration_mps2,
        adaptive=False, blockage_aware=True, robust=True,
    )  # fmt: skip


def _rejecting(mode: Mode) -> Mode:
    return replace(mode, robust=False)


# Of steady motion, so that what contradicts them is an outlier rather than a maneuver.
STAND, CRUISE = _rejecting(_mode("stand", "ekf", 0.05)), _rejecting(_mode("cruise", "ukf", 0.5))
TURN = _mode("turn", "ukf", 1.9)
ACCELERATE, BRAKE = _mode("accelerate", "ukf", 0.3, 2.0), _mode("brake", "ukf", 0.2, -2.0)
PULL_AWAY, STOP = _mode("pull-away", "ukf", 0.3, 4.0), _mode("stop", "ukf", 0.2, -4.0)
REACQUIRE = Mode("reacquire", "ukf", sigma_v=2.0, adaptive=False, gate=None, widen_p=10.0)
DOUBTING = (replace(STAND, robust=True), replace(CRUISE, robust=True))
LEFT, RIGHT = (replace(_mode(name, "ukf", 0.5), turn_rate_radps=rate)
               for name, rate in (("left", 0.3), ("right", -0.3)))  # fmt: skip
_MANEUVERS = (STAND, CRUISE, TURN, ACCELERATE, BRAKE)


@dataclass(frozen=True)
class Design:
    """A bank before it is tuned.

    Attributes:
        modes: to begin with; what of them is data is tuned.
        proportional: each mode is left for the others in the same proportions, as in
            :func:`~experiments.tuning.search_space.transition_of`; False for a transition matrix
            that is free in every entry.
    """

    modes: tuple[Mode, ...]
    proportional: bool = False


DESIGNS = {
    "maneuvers": Design(_MANEUVERS),
    "two": Design((STAND, TURN)),
    "three": Design((STAND, CRUISE, TURN)),
    "proportional": Design(_MANEUVERS, proportional=True),
    "doubting": Design((*DOUBTING, *_MANEUVERS[2:])),
    "reacquire": Design((*_MANEUVERS, REACQUIRE)),
    "turn-rates": Design((*_MANEUVERS, LEFT, RIGHT)),
    "two-levels": Design((*_MANEUVERS, PULL_AWAY, STOP)),
}
