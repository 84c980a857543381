"""Banks before they are tuned, each of them with other parts."""

from dataclasses import dataclass

from mmwave_env.filters.modes import Mode

# Where the search starts: where an earlier one, of fewer numbers, had ended.
_ROBUST = {"robust": True, "blockage_aware": True, "adaptive": False, "sigma_p": 0.01}
STAND = Mode("stand", "ekf", sigma_v=0.04, **_ROBUST)
CRUISE = Mode("cruise", "ukf", sigma_v=0.5, **_ROBUST)
TURN = Mode("turn", "ukf", sigma_v=1.9, **_ROBUST)
ACCELERATE = Mode("accelerate", "ukf", sigma_v=0.3, acceleration_mps2=2.0, **_ROBUST)
BRAKE = Mode("brake", "ukf", sigma_v=0.2, acceleration_mps2=-2.0, **_ROBUST)
GATED = Mode("gated", "ukf", sigma_v=0.8, adaptive=False, blockage_aware=True)
REACQUIRE = Mode("reacquire", "ukf", sigma_v=2.0, adaptive=False, gate=None, widen_p=10.0)
PULL_AWAY = Mode("pull-away", "ukf", sigma_v=0.3, acceleration_mps2=4.0, **_ROBUST)
STOP = Mode("stop", "ukf", sigma_v=0.2, acceleration_mps2=-4.0, **_ROBUST)
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
    "gated": Design((*_MANEUVERS, GATED)),
    "reacquire": Design((*_MANEUVERS, REACQUIRE)),
    "two-levels": Design((*_MANEUVERS, PULL_AWAY, STOP)),
}
