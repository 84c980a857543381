"""Directions at the base station and at its mirror images."""

import numpy as np
import pytest

from mmwave_env.models.measurement import seen_from_image

STATION = np.array([1.0, 2.0, 8.0])


def angles(d):
    return np.arctan2(d[1], d[0]), np.arctan2(d[2], np.hypot(d[0], d[1]))


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (0.6, -0.8, 0.0), (0.0, 0.0, -1.0)])
def test_a_path_by_a_wall_is_straight_from_the_image(normal):
    n, offset = np.array(normal), 5.0  # a wall, or the ground, this far from the station
    image = STATION + 2.0 * offset * n
    user = STATION + np.array([20.0, 7.0, -6.5]) @ (np.eye(3) - np.outer(n, n)) - 3.0 * n
    share = offset / (offset + 3.0 + offset)  # of the way from the image where it meets the wall
    bounce = image + share * (user - image)
    assert (bounce - STATION) @ n == pytest.approx(offset)
    found = seen_from_image(*angles(bounce - STATION), STATION.tolist(), image.tolist())
    assert found == pytest.approx(angles(user - image))


def test_without_a_wall_nothing_changes():
    assert seen_from_image(2.5, -0.3, STATION, STATION) == pytest.approx((2.5, -0.3))
