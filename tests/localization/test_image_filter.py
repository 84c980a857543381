"""Tests of the joint filter of a user and mirror images, against numbers that it does not use."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.filters.bank import default_modes
from mmwave_env.localization.association import PathTracker
from mmwave_env.localization.image_filter import (
    Belief,
    Image,
    Paths,
    block,
    link_rows,
    merged,
    reduced,
)
from mmwave_env.localization.map_learning import MapLearner
from mmwave_env.models.measurement import seen_from_image
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import scene_of_anchors

STATION = np.array([0.0, 3.0, 8.0])
IMAGES = np.array([[0.0, 17.0, 8.0], [-30.0, 40.0, 8.0]])
ANCHORS = np.vstack([STATION, IMAGES])
USER = np.array([21.0, -4.0, 1.5])
SCENE = scene_of_anchors("yard", ANCHORS, 28e9, 400e6)
RECEIVER = (RADIOS["standard"], default_modes("standard")[-1])
FILTER = PathTracker(SCENE, *RECEIVER)
either_end = pytest.mark.parametrize("at_station", [False, True])


def belief(places=IMAGES, sigma_m=0.5, **image):
    """Return a belief about a user at ``USER`` with correlated images."""
    n = 7 + 3 * len(places)
    A = np.random.default_rng(0).standard_normal((n, n))
    x = np.concatenate([USER, [1.0, 0.5, 0.0, 3.0], np.ravel(places)])
    images = tuple(Image(paths=9, confirmed=True, **image) for _ in places)
    return Belief(x, sigma_m**2 * (np.eye(n) + 0.1 * A @ A.T / n), images, 0.0)


def paths_from(anchors, at_station=False, deviation=0.01):
    """Return exact paths of the user at ``USER`` from these anchors."""
    h, _, _ = link_rows(USER, np.vstack([STATION, anchors]), at_station)
    n = len(anchors)
    variance = np.full((n, 2, 4), deviation**2)
    shift = np.full(n, np.nan)
    straight = np.ones(n, bool)
    return Paths(0.0, h[1:], shift, variance, shift, straight, at_station)


def test_arrivals_at_the_station_are_mirrored_in_the_wall():
    at_station, _, _ = link_rows(USER, ANCHORS, at_station=True)
    at_image, _, _ = link_rows(USER, ANCHORS, at_station=False)
    for image, angles, expected in zip(IMAGES, at_station[1:], at_image[1:], strict=True):
        arrival = seen_from_image(angles[1], angles[2], STATION.tolist(), image.tolist())
        assert_allclose(arrival, expected[1:3], atol=1e-9)


@either_end
def test_gradients_are_those_of_finite_differences(at_station):
    _, by_p, by_a = link_rows(USER, ANCHORS, at_station)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-5
        images = np.vstack([np.zeros(3), [step] * len(IMAGES)])  # the station stays
        for user, anchors, gradients in ((step, 0.0, by_p), (0.0, images, by_a[1:])):
            ahead, _, _ = link_rows(USER + user, ANCHORS + anchors, at_station)
            behind, _, _ = link_rows(USER - user, ANCHORS - anchors, at_station)
            slope = (ahead - behind) / 2e-5
            assert_allclose(slope[-len(gradients) :], gradients[:, :, axis], atol=1e-7)


@pytest.mark.parametrize("kind", [PathTracker, MapLearner])
def test_ranges_contain_what_offsets_of_anchors_differ_by(kind):
    scene = replace(SCENE, range_offset_m=(2.0, 2.5, 1.0))
    h, _ = kind(scene, *RECEIVER).rows(belief(), at_station=False)
    expected, _ = FILTER.rows(belief(), at_station=False)
    assert_allclose((h - expected)[:, 0], [0.0, 0.5, -1.0])
    assert_array_equal(h[:, 1:], expected[:, 1:])


def test_an_update_with_all_paths_at_once_is_the_textbook_update():
    b = belief()
    paths = paths_from(IMAGES + [[0.3, -0.2, 0.1]], deviation=0.5)
    nis, _ = FILTER.nis(b, paths)
    updated = FILTER.updated(b, paths, {1: 0, 2: 1}, nis)
    h, H = FILTER.rows(b, at_station=False)
    H = H[1:].reshape(8, -1)
    S = H @ b.P @ H.T + 0.25 * np.eye(8)
    K = b.P @ H.T @ np.linalg.inv(S)
    assert_allclose(updated.x, b.x + K @ (paths.z - h[1:]).ravel(), atol=1e-9)
    assert_allclose(updated.P, b.P - K @ S @ K.T, atol=1e-9)


def test_a_path_of_a_tentative_image_does_not_move_the_user():
    b = belief()
    paths = paths_from(IMAGES + 1.0)
    updated = FILTER.updated(b, paths, {2: 1}, np.zeros((3, 2)), only=block(2))
    others = np.r_[0 : block(2).start]
    assert_allclose(updated.x[others], b.x[others], rtol=1e-12)
    kept = np.ix_(others, others)
    assert_allclose(updated.P[kept], b.P[kept], atol=1e-12)
    h, H = FILTER.rows(b, at_station=False)
    gain = b.P[block(2)] @ H[2].T @ np.linalg.inv(H[2] @ b.P @ H[2].T + 0.01**2 * np.eye(4))
    assert_allclose(updated.places[1], IMAGES[1] + gain @ (paths.z[1] - h[2]))
    assert np.linalg.eigvalsh(updated.P).min() > 0.0


@either_end
def test_a_new_image_is_where_its_path_seems_to_come_from(at_station):
    b = belief(places=np.zeros((0, 3)), sigma_m=0.1)
    alone = PathTracker(SCENE.with_anchors(ANCHORS[:1]), *RECEIVER)
    born = alone.with_image(b, paths_from(IMAGES, at_station), 0)
    error = born.places[0] - IMAGES[0]
    P = born.P[block(1), block(1)]
    assert np.linalg.norm(error) < 0.1 and error @ np.linalg.solve(P, error) < 1.0
    assert np.sqrt(P[2, 2]) <= 0.1  # as high as the base station
    assert_allclose(born.P[:7, :7], b.P, rtol=1e-12)
    assert np.linalg.eigvalsh(born.P).min() > 0.0


def test_only_images_that_are_to_be_learned_become_less_certain():
    for exact in (False, True):
        b = belief(exact=exact)
        later = FILTER.predicted(b, 10.0)
        grown = np.diag(later.P - b.P)[7:]
        assert_allclose(grown, 0.0 if exact else 10.0 * 0.02**2, atol=1e-12)


def test_images_are_removed_with_their_part_of_the_state():
    b = belief()._replace(labels={0: 4, 2: 1})
    rest = reduced(b, [False, True])
    kept = np.r_[0:7, 10:13]
    assert_array_equal(rest.x, b.x[kept])
    assert_array_equal(rest.P, b.P[np.ix_(kept, kept)])
    assert rest.labels == {0: 4, 1: 1} and len(rest.images) == 1


def test_of_two_equal_images_the_one_with_more_paths_stays():
    b = belief(places=IMAGES[[0, 0, 1]] + [[0.0], [0.3], [0.0]])
    b = b._replace(images=(Image(paths=3), Image(paths=8), Image(paths=1)))
    assert [image.paths for image in merged(b).images] == [8, 1]
