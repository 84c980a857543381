"""The envelope: ranges of numbers within which the filters are sound, also at any two ends at once.

An episode or a mode outside the envelope is refused, and the message names the number. A double
has 16 digits, and an update adds a measurement's information, P / sigma^2, to 1: where the prior's
deviation is 1e8 times the noise in one direction but not in another, the digits of the other are
lost. The ends are far from anything a receiver gives; tests/engines/test_extremes.py tries them.
"""

from mmwave_env.io.records import between

STEP_S = between(1e-6, 60.0, "s")  # between epochs
HZ_PER_MPS = between(1e-3, 1e4, "Hz per m/s")  # a carrier of 300 kHz to 3 THz
DOPPLER_SPREAD_HZ = between(0.0, 1e5, "Hz")
POSITION_M = between(-1e6, 1e6, "m")  # per axis, of anchors and of the prior
VELOCITY_MPS = between(-1e4, 1e4, "m/s")  # per axis, of the prior
BIAS_HZ = between(-1e7, 1e7, "Hz")  # of the prior
# standard deviations of the prior
POSITION_SIGMA_M = between(1e-4, 1e4, "m")
VELOCITY_SIGMA_MPS = between(1e-4, 1e2, "m/s")
BIAS_SIGMA_HZ = between(1e-8, 1e6, "Hz")
# and of measurements; odometry's speed as a range
RANGE_SIGMA_M = between(1e-3, 1e5, "m")
ANGLE_SIGMA_RAD = between(1e-5, 1e2, "rad")
DOPPLER_SIGMA_HZ = between(0.02, 1e6, "Hz")
# of modes
PROCESS_NOISE = between(0.0, 30.0)  # each in its own unit per root second
