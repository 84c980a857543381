"""The prior of a track: mean and covariance of the state at the first epoch."""

import math

import numpy as np

from mmwave_env.models.radio import Radio
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import PI, Array, wrap

# Longest gap in a track: filters lost none of 100 vehicles in gaps of 10 s, but some in 20 s gaps.
GAP_S = 15.0
# A prior is computed only from links with elevations up to this one, 5 degrees off the vertical.
# These 5 degrees are 2.5 standard deviations of an elevation measured by the radio "handset".
STEEPEST_FIX_RAD = math.radians(85.0)


def prior_from_fix(
    anchor: Array, link: Array, sigma: Array, radio: Radio, scene: Scene
) -> tuple[Array, Array]:
    """Return a prior computed from one link (4,): the mean (7,), at rest, and covariance (7, 7).

    ``anchor`` is (3,), and ``sigma`` (4,) contains the standard deviations of the link.
    """
    away, covariance_of_position = vector_from_link(link, sigma)
    covariance = radio.prior_covariance(scene)
    covariance[:3, :3] = covariance_of_position
    covariance[3, 3] = covariance[4, 4] = radio.start_velocity_mps**2
    return np.concatenate([anchor + away, np.zeros(4)]), covariance


def vector_from_link(link: Array, sigma: Array) -> tuple[Array, Array]:
    """Return the vector (3,) from the anchor to the user, m, and its linearized covariance (3, 3).

    The vector is range (cos el cos az, cos el sin az, sin el). ``link`` (4,) are the values of a
    link, and ``sigma`` (4,) their standard deviations. The two azimuths are averaged by their
    inverse variances.
    """
    distance, azimuth, elevation, departure = link
    arrival_variance = sigma[1] ** 2
    departure_variance = sigma[3] ** 2
    weight = arrival_variance / (arrival_variance + departure_variance)
    azimuth = azimuth + weight * wrap(departure - azimuth + PI)
    cos_az = np.cos(azimuth)
    sin_az = np.sin(azimuth)
    cos_el = np.cos(elevation)
    sin_el = np.sin(elevation)
    along = np.array([cos_el * cos_az, cos_el * sin_az, sin_el])
    across = np.array([-cos_el * sin_az, cos_el * cos_az, 0.0])
    up = np.array([-sin_el * cos_az, -sin_el * sin_az, cos_el])
    jacobian = np.column_stack([along, distance * across, distance * up])
    variance = [sigma[0] ** 2, weight * departure_variance, sigma[2] ** 2]
    return distance * along, (jacobian * variance) @ jacobian.T
