"""The envelope: numbers that the filters are sound for, each at its ends and any two at theirs.

Outside of it an episode or a mode is refused by name. A double has 16 digits, and an update adds
what a measurement says, P / sigma^2, to 1: where a prior deviates a hundred million times as much
as the noise in one direction and not in another, nothing is left of the other. The ends stand far
from anything a receiver gives; tests/engines/test_extremes.py tries them.
"""

from mmwave_env.records import Bound


def _between(least: float, most: float, unit: str = "") -> Bound:
    return Bound(f"a number of {least:g} to {most:g} {unit}".rstrip(), least=least, most=most)


STEP_S = _between(1e-30, 60.0, "s")  # between epochs
HZ_PER_MPS = _between(1e-3, 1e4, "Hz per m/s")  # a carrier of 300 kHz to 3 THz
DOPPLER_SPREAD_HZ = _between(0.0, 1e5, "Hz")
POSITION_M = _between(-1e6, 1e6, "m")  # per axis, of anchors and of the prior
VELOCITY_MPS = _between(-1e4, 1e4, "m/s")  # per axis, of the prior
BIAS_HZ = _between(-1e7, 1e7, "Hz")  # of the prior
# standard deviations of the prior
POSITION_SIGMA_M = _between(1e-4, 1e4, "m")
VELOCITY_SIGMA_MPS = _between(1e-4, 1e3, "m/s")
BIAS_SIGMA_HZ = _between(1e-8, 1e6, "Hz")
# and of measurements; odometry's speed as a range
RANGE_SIGMA_M = _between(1e-3, 1e5, "m")
ANGLE_SIGMA_RAD = _between(1e-5, 1e2, "rad")
DOPPLER_SIGMA_HZ = _between(0.1, 1e6, "Hz")
# of modes
PROCESS_NOISE = _between(0.0, 30.0)  # each in its own unit per root second
WIDENING = _between(0.0, 100.0)  # m, m/s
