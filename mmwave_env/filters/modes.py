"""Modes: filter algorithms, each with a tuning and with safeguards against wrong measurements."""

from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

from mmwave_env.filters.update import Algorithm, ckf, ekf, ukf
from mmwave_env.io.lookup import choose, quoted
from mmwave_env.io.records import Bound, Name, between, counts, require_fields
from mmwave_env.models.envelope import PROCESS_NOISE
from mmwave_env.numerics.numbers import Number

ALGORITHMS: dict[str, Algorithm] = {"ekf": ekf, "ukf": ukf, "ckf": ckf}
Noise = Annotated[float, PROCESS_NOISE]
Quantile = Annotated[float, Bound("a quantile in (0, 1)", above=0.0, below=1.0)]

DESIGN_LIMIT_MPS = 20.0  # the paper's filters are not designed for greater speeds


class Tuning(NamedTuple):
    """A mode's motion model as numbers, so that one compiled filter can run many tunings.

    The attributes mean the same as in :class:`Mode`; ``coupling`` is 1 or 0.
    """

    sigma_p: Number
    sigma_v: Number
    sigma_pz: Number
    sigma_vz: Number
    sigma_b_mps: Number
    spread_gain: Number
    coupling: Number
    acceleration_mps2: Number


@dataclass(frozen=True)
class Mode:
    """One filter pipeline of the paper (Sec. III).

    The unit of process noise contains 1 / sqrt(s), so a tuning is valid for any time dt between
    epochs. If dt is 1 s, as in the paper, the values are the standard deviations per epoch.

    Attributes:
        name: name to show in tables and messages; up to 80 characters.
        algorithm: "ekf", "ukf", "ckf", or a function with the signature of
            :data:`~mmwave_env.filters.update.Algorithm` (docs/own-filters.md).
        sigma_p: extra horizontal position noise, m / sqrt(s).
        sigma_v: horizontal velocity noise, (m/s) / sqrt(s).
        sigma_pz: extra vertical position noise, m / sqrt(s).
        sigma_vz: vertical velocity noise, (m/s) / sqrt(s).
        sigma_b_mps: oscillator drift, (m/s) / sqrt(s); multiply by f_c / c to get hertz.
        spread_gain: horizontal velocity variance per hertz of Doppler spread,
            (m/s)^2 / s / Hz, in addition to sigma_v^2 (paper, Sec. II-A).
        coupling: whether velocity noise also moves the position within a step (discrete
            white-noise acceleration); False for the paper's diagonal Q.
        acceleration_mps2: assumed acceleration along the predicted horizontal velocity, m/s^2; if
            it is negative, the user brakes, at most to a standstill.
        gate: probability, such as 0.99: a gate accepts NIS up to the chi-square quantile of this
            probability; None for no gates (paper, Sec. III-D).
        recovery: if all visible links fail their gates in this number of epochs in a row, all links
            are accepted until one passes its gate again; None for never, as in the paper.
        adaptive: whether to scale Q and R by the windowed mean of NIS (paper, Sec. III-E).
        blockage_aware: whether to inflate R of a link whose SNR fell below its slow running mean.
        robust: whether to inflate R of a link with a large NIS instead of rejecting it.
        cost: amount to subtract from the reward of every epoch in which this mode runs.
    """

    name: Name
    algorithm: str | Algorithm = "ekf"
    sigma_p: Noise = 0.1
    sigma_v: Noise = 0.5
    sigma_pz: Noise = 0.02
    sigma_vz: Noise = 0.03
    sigma_b_mps: Noise = 0.05
    spread_gain: Noise = 0.0
    coupling: bool = True
    acceleration_mps2: Annotated[float, between(-100.0, 100.0, "m/s^2")] = 0.0
    gate: Quantile | None = 0.99
    recovery: Annotated[int, counts(1, 1_000_000)] | None = 2
    adaptive: bool = True
    blockage_aware: bool = False
    robust: bool = False
    cost: Annotated[float, between(0.0, 1e6)] = 0.0

    def __post_init__(self) -> None:
        require_fields(self, f" of mode {quoted(self.name)}")
        if isinstance(self.algorithm, str):
            choose(ALGORITHMS, self.algorithm, f"algorithm of mode {self.name!r}")

    @property
    def tuning(self) -> Tuning:
        """Return the parameters of the motion model: process noise and acceleration."""
        return Tuning(*(float(getattr(self, field)) for field in Tuning._fields))

    @property
    def update(self) -> Algorithm:
        """Return the measurement update that this mode runs."""
        return ALGORITHMS[self.algorithm] if isinstance(self.algorithm, str) else self.algorithm


def robust(mode: Mode) -> Mode:
    """Return the mode with robust, blockage-aware updates of the links instead of gates.

    The returned mode has no adaptive scaling: a robust update already reacts to a large NIS, and
    scaling Q and R by the NIS, too, would count it twice.
    """
    name = f"{mode.name}-robust"
    return replace(mode, name=name, robust=True, blockage_aware=True, adaptive=False)
