"""The choice of a localizer for a log: a policy, an IMM, or the paper's Algorithm 1."""

import warnings
from dataclasses import replace

import numpy as np

from experiments.console.options import LogArgs, require_alone, require_default
from experiments.evaluation.contenders import BEST_IMM, contender_from
from mmwave_env.filters.bank import Bank, bank_from, best_bank, default_modes, modes_from
from mmwave_env.filters.modes import DESIGN_LIMIT_MPS, Mode, robust
from mmwave_env.interface.policy import Rule, Switching
from mmwave_env.io.lookup import choose
from mmwave_env.logs.lines import number
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.models.scene import Scene, scene_from
from policies.rules import SLOW_MPS, by_odometry_speed, by_predicted_speed, mode_at

# "corrector" corrects the beliefs of "guided". Without elevations, "guided" chooses wrong modes so
# often that neither of the two is useful (docs/learning.md).
WITHOUT_ELEVATIONS = BEST_IMM
RULES: dict[str, tuple[Rule, str]] = {  # --follow -> (rule, words before "speed" in reports)
    "prediction": (by_predicted_speed, "the predicted"),
    "odometry": (by_odometry_speed, "odometry's"),
}


def is_algorithm_1(args: LogArgs) -> bool:
    """Return whether the paper's Algorithm 1 is chosen, by one of its options."""
    if args.imm or args.policy:
        return False
    chosen = args.speed is not None or args.modes is not None
    return chosen or args.robust or args.follow != "prediction"


def require_one_choice(args: LogArgs) -> None:
    """Refuse options of a policy, an IMM and Algorithm 1 that contradict each other."""
    require_alone(args, "imm", "speed", "modes", "policy", "follow")
    require_alone(args, "policy", "speed", "modes", "follow", "robust")
    if not args.imm:
        require_default(args, "--imm", "climb")
    by_speed = args.speed not in (None, "auto")
    if args.outside == "abort" and not by_speed:
        raise ValueError("outside: abort needs a number for --speed (in m/s)")
    if args.follow == "odometry" and by_speed:
        raise ValueError("follow: odometry needs --speed auto")


def scene_of(args: LogArgs, name: str) -> Scene:
    """Return the scene of a log, with the place near the user that --start gives."""
    scene = scene_from(name)
    if args.start is None:
        return scene
    place = [number(word) for word in args.start.split(",")]
    if not (len(place) in (2, 3) and np.isfinite(place).all()):
        raise ValueError(f"start: found {args.start!r}, expected X,Y in meters, such as 10.5,-20")
    return replace(scene, side=(place[0], place[1]))


def radio_of(args: LogArgs, name: str) -> Radio:
    """Return the profile of this name or file, with the velocity that --prior-speed gives."""
    radio = radio_from(name)
    if args.prior_speed is None:
        return radio
    try:
        return replace(radio, start_velocity_mps=args.prior_speed)
    except ValueError as error:
        raise ValueError(f"prior-speed: {error}") from error


def choice_of(args: LogArgs, radio: str, elevations: bool) -> tuple[Switching, str]:
    """Return the modes to run with their rule or policy, and words after "modes" in reports.

    The default is a policy, or an IMM if the log has no elevations.

    Raises:
        ValueError: a policy, a bank or a mode is unknown or not valid.
    """
    if args.imm is not None:
        bank = _bank(args.imm, radio)
        modes = bank.modes
        if args.robust:
            modes = tuple(map(robust, modes))
        if args.climb is not None:
            modes = tuple(replace(mode, sigma_vz=args.climb) for mode in modes)
        why = f"of {args.imm}, weighted by their probability"
        return Switching(replace(bank, modes=modes)), why
    if not is_algorithm_1(args):
        if args.policy is None and not elevations:
            why = f"of {WITHOUT_ELEVATIONS} (no elevations), weighted by their probability"
            return Switching(_bank(WITHOUT_ELEVATIONS, radio)), why
        # "corrector" needs an uncertain height; a known height has the standard deviation 0.
        name = args.policy or ("corrector" if args.height is None else "guided")
        return contender_from(name, radio), f"chosen by the policy {name}"
    modes = modes_of(args, radio)  # from here on, Algorithm 1, Step 3
    if args.speed in (None, "auto"):
        rule, followed = RULES[args.follow]
        why = f"chosen by whether {followed} speed is above {SLOW_MPS:g} m/s"
        return Switching(modes, rule), why
    word = args.speed.strip()
    speed = number(word)
    if not 0.0 <= speed < float("inf"):
        raise ValueError(f"speed: found {word!r}, expected a speed in m/s, 0 or more")
    mode = modes[int(mode_at(speed))]
    if speed > DESIGN_LIMIT_MPS:
        window = f"outside the design window (up to {DESIGN_LIMIT_MPS:g} m/s)"
        if args.outside == "abort":
            raise ValueError(f"speed: found {speed:g} m/s, {window}; --outside fallback allows it")
        warnings.warn(f"speed {speed:g} m/s is {window}; falling back to {mode.name}", stacklevel=2)
    side = "up to" if speed <= SLOW_MPS else "above"
    return Switching((mode,)), f"for {speed:g} m/s, which is {side} {SLOW_MPS:g} m/s"


def _bank(name: str, radio: str) -> Bank:
    """Return an IMM's bank (modes, transition probabilities), by name or from a mode file."""
    if name.endswith(".json"):
        return bank_from(name, radio)
    makes = {"imm": lambda radio: Bank(default_modes(radio)), BEST_IMM: best_bank}
    return choose(makes, name, "imm")(radio)


def modes_of(args: LogArgs, radio: str) -> tuple[Mode, ...]:
    """Return the low-mobility and the high-mobility pipeline of Algorithm 1."""
    if args.modes is not None and args.modes.suffix != ".json":
        raise ValueError(f"modes: found {str(args.modes)!r}, expected a mode file (.json)")
    modes = modes_from(args.modes, radio)
    if len(modes) != 2:
        raise ValueError(
            f"{args.modes}: found {len(modes)} modes, expected 2, for low and for high mobility"
        )
    return tuple(map(robust, modes)) if args.robust else modes
