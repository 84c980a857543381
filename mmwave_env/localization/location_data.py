"""Positions as LocationData of 3GPP TS 29.572, the JSON that location servers exchange."""

from math import atan2, degrees, hypot, log, sqrt
from statistics import NormalDist

import numpy as np

from mmwave_env.io.files import Json
from mmwave_env.localization.map_files import UNIX_S, east_north, ellipses_of, iso_time
from mmwave_env.localization.tracker import Position
from mmwave_env.models.scene import Origin

_KMH = 3.6  # km/h in 1 m/s


def location_data(
    position: Position, origin: Origin, confidence: float, accuracy_m: float | None
) -> Json:
    """Return a position and its velocity as LocationData (TS 29.572, section 6.1.6.2.3).

    Args:
        position: belief about the user, in a scene with this origin.
        origin: location of the scene on the earth.
        confidence: probability that the user is in the ellipse, and between the heights.
        accuracy_m: largest half axis of the ellipse that fulfils the request; None for no request.
    """
    assert position.geodetic
    latitude, longitude, height = position.geodetic
    turn = east_north(origin)
    variance = np.array(position.covariance_m2)
    major, minor, azimuth = map(float, ellipses_of(origin, variance[[0, 1, 1], [0, 0, 1]]))
    scale = sqrt(-2.0 * log(1.0 - confidence))  # chi-square quantile, 2 degrees of freedom
    percent = round(100.0 * confidence)
    east, north = (turn @ position.velocity_mps[:2]).tolist()
    up = position.velocity_mps[2]
    content: Json = {
        "locationEstimate": {
            "shape": "POINT_ALTITUDE_UNCERTAINTY",
            "point": {"lon": longitude, "lat": latitude},
            "altitude": height,
            "uncertaintyEllipse": {
                "semiMajor": scale * major,
                "semiMinor": scale * minor,
                "orientationMajor": round(azimuth),
            },
            "uncertaintyAltitude": NormalDist().inv_cdf(0.5 + 0.5 * confidence)
            * sqrt(variance[2, 2]),
            "confidence": percent,
            "vConfidence": percent,
        },
        "velocityEstimate": {
            "hSpeed": _KMH * hypot(east, north),
            "bearing": round(degrees(atan2(east, north))) % 360,
            "vSpeed": _KMH * abs(up),
            "vDirection": "UPWARD" if up >= 0.0 else "DOWNWARD",
        },
    }
    if position.time_s > UNIX_S:
        content["timestampOfLocationEstimate"] = iso_time(position.time_s)
    if accuracy_m is not None:
        fulfilled = scale * major <= accuracy_m
        content["accuracyFulfilmentIndicator"] = (
            "REQUESTED_ACCURACY_FULFILLED" if fulfilled else "REQUESTED_ACCURACY_NOT_FULFILLED"
        )
    return content
