"""Modes: a filter algorithm with the tuning and the safeguards it was optimised with."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from mmwave_env.arithmetic import Number
from mmwave_env.estimator.update import Algorithm, ckf, ekf, ukf
from mmwave_env.names import choose

ALGORITHMS: dict[str, Algorithm] = {"ekf": ekf, "ukf": ukf, "ckf": ckf}

# Low-mobility velocity noise by radio profile, m/s per square root of a second, from a coarse
# grid on this model's prototype (the profile "high" takes that of "standard"); the
# high-mobility mode has 1.8 everywhere. No command of the package re-tunes them yet.
LOW_MOBILITY_SIGMA_V = {"handset": 0.3, "standard": 0.5, "high": 0.5}


class Tuning(NamedTuple):
    """A mode's process noise as numbers, so that one compiled filter can run many tunings.

    Attributes are those of :class:`Mode`; ``coupling`` is 1 or 0.
    """

    sigma_p: Number
    sigma_v: Number
    sigma_pz: Number
    sigma_vz: Number
    sigma_b_mps: Number
    spread_gain: Number
    coupling: Number


@dataclass(frozen=True)
class Mode:
    """One filter pipeline of the paper (Sec. III).

    Process noise is given per square root of a second, so a tuning holds at any rate; at
    the paper's dt = 1 s the figures are the standard deviations per epoch.

    Attributes:
        name: shown in tables and messages.
        algorithm: "ekf", "ukf", "ckf", or a function with the signature of
            :data:`~mmwave_env.estimator.update.Algorithm`.
        sigma_p: extra horizontal position noise, m / sqrt(s).
        sigma_v: horizontal velocity noise, (m/s) / sqrt(s).
        sigma_pz: extra vertical position noise, m / sqrt(s).
        sigma_vz: vertical velocity noise, (m/s) / sqrt(s).
        sigma_b_mps: oscillator drift, (m/s) / sqrt(s); times f_c / c in hertz.
        spread_gain: horizontal velocity variance per hertz of Doppler spread,
            (m/s)^2 / s / Hz, on top of sigma_v^2 (paper, Sec. II-A).
        coupling: whether velocity noise also moves the position within a step (discrete
            white-noise acceleration); False is the paper's plain diagonal.
        gate: chi-square quantile of the gates; None for no gates (paper, Sec. III-D).
        recovery: epochs in a row with every visible link rejected after which the next
            update accepts the links; None for never, as in the paper.
        adaptive: scale Q and R by the windowed mean of NIS (paper, Sec. III-E).
        blockage_aware: inflate R of a link whose SNR has dropped below its slow mean.
        robust: inflate R of a link with a large NIS instead of rejecting it.
        widen_p: re-acquire: add this squared to the predicted position variance, m.
        widen_v: re-acquire: add this squared to the predicted velocity variance, m/s.
        cost: subtracted from the reward of every epoch that runs this mode.
    """

    name: str
    algorithm: str | Algorithm = "ekf"
    sigma_p: float = 0.1
    sigma_v: float = 0.5
    sigma_pz: float = 0.02
    sigma_vz: float = 0.03
    sigma_b_mps: float = 0.05
    spread_gain: float = 0.0
    coupling: bool = True
    gate: float | None = 0.99
    recovery: int | None = 2
    adaptive: bool = True
    blockage_aware: bool = False
    robust: bool = False
    widen_p: float = 0.0
    widen_v: float = 0.0
    cost: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.algorithm, str):
            choose(ALGORITHMS, self.algorithm, f"algorithm of mode {self.name!r}")
        for field in (
            "sigma_p", "sigma_v", "sigma_pz", "sigma_vz", "sigma_b_mps", "spread_gain",
            "widen_p", "widen_v", "cost",
        ):  # fmt: skip
            value = getattr(self, field)
            if not 0.0 <= value < float("inf"):
                raise ValueError(f"{field} of mode {self.name!r}: found {value}, expected >= 0")
        if self.gate is not None and not 0.0 < self.gate < 1.0:
            raise ValueError(
                f"gate of mode {self.name!r}: found {self.gate}, expected a quantile in (0, 1) "
                "or None"
            )
        if self.recovery is not None and self.recovery < 1:
            raise ValueError(
                f"recovery of mode {self.name!r}: found {self.recovery}, expected a number of "
                "epochs >= 1 or None"
            )

    @property
    def tuning(self) -> Tuning:
        """Its process noise."""
        return Tuning(*(float(getattr(self, field)) for field in Tuning._fields))

    @property
    def update(self) -> Algorithm:
        """The measurement update this mode runs."""
        return ALGORITHMS[self.algorithm] if isinstance(self.algorithm, str) else self.algorithm


def low_mobility(radio: str = "handset") -> Mode:
    """Action 0: EKF with small velocity noise, tuned per radio profile."""
    return Mode("ekf", "ekf", sigma_v=LOW_MOBILITY_SIGMA_V.get(radio, 0.5))


def high_mobility() -> Mode:
    """Action 1: UKF with velocity noise for vehicles."""
    return Mode("ukf", "ukf", sigma_v=1.8)


def default_modes(radio: str = "handset") -> tuple[Mode, Mode]:
    """The two actions of ``MmWaveLoc-v0``: the paper's EKF and UKF pipelines."""
    return low_mobility(radio), high_mobility()


def named_modes(radio: str = "handset") -> dict[str, Mode]:
    """Modes that can be asked for by name: ekf, ukf and ckf (the UKF's tuning)."""
    low, high = default_modes(radio)
    return {"ekf": low, "ukf": high, "ckf": replace(high, name="ckf", algorithm="ckf")}


def modes_from(modes: Sequence[Mode | str] | None, radio: str = "handset") -> tuple[Mode, ...]:
    """The modes of a ``modes=`` argument: names or Mode objects, None for the default two.

    Raises:
        ValueError: for an empty list, two modes of one name, or an unknown name.
    """
    if modes is None:
        return default_modes(radio)
    if isinstance(modes, str):
        raise ValueError(f"modes: found the string {modes!r}, expected a list such as ['ekf']")
    known = named_modes(radio)
    result = tuple(m if isinstance(m, Mode) else choose(known, m, "mode") for m in modes)
    names = [m.name for m in result]
    if not result or len(set(names)) < len(names):
        raise ValueError(f"modes: found {names}, expected at least one mode and no name twice")
    return result
