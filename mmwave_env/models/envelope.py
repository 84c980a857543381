"""Limits of inputs, within which filters are accurate, even if two inputs are at their limits.

Episodes and filter modes with values beyond the limits are refused. Each update adds ratios of
prior variance to noise variance, one per direction of the state. A double has 16 digits: a ratio
near 1 is lost beside a ratio of 1e16 (1e8 for standard deviations). Receivers report values far
inside the limits; tests/engines/test_extremes.py tests the limits.
"""

from mmwave_env.io.records import between

STEP_S = between(1e-6, 60.0, "s")  # time between epochs
HZ_PER_MPS = between(1e-3, 1e4, "Hz per m/s")  # for carriers of 300 kHz to 3 THz
DOPPLER_SPREAD_HZ = between(0.0, 1e5, "Hz")
POSITION_M = between(-1e7, 1e7, "m")  # per axis, for anchors and for the prior's mean
VELOCITY_MPS = between(-1e4, 1e4, "m/s")  # per axis, for the prior's mean
BIAS_HZ = between(-1e7, 1e7, "Hz")  # oscillator bias in the prior's mean
# standard deviations of the prior
POSITION_SIGMA_M = between(1e-4, 1e4, "m")
VELOCITY_SIGMA_MPS = between(1e-4, 1e2, "m/s")
BIAS_SIGMA_HZ = between(1e-8, 1e6, "Hz")
# standard deviations of measurements; RANGE_SIGMA_M also holds for odometry's speed, in m/s
RANGE_SIGMA_M = between(1e-3, 1e5, "m")
ANGLE_SIGMA_RAD = between(1e-5, 1e2, "rad")
DOPPLER_SIGMA_HZ = between(0.02, 1e6, "Hz")
PROCESS_NOISE = between(0.0, 30.0)  # standard deviations of a mode's process noise over 1 s
