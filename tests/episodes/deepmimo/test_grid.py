import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.episodes.deepmimo.grid import nearest_users, surrounding_users


def grid(step, columns=20, rows=20, height=2.0):
    x, y = step * np.arange(columns), step * np.arange(rows)
    return np.stack(np.meshgrid(x, y, [height]), axis=-1).reshape(-1, 3)


def ways(seed, users, count=200):
    """Places in the middle of a grid, and above it."""
    low, high = users.min(axis=0), users.max(axis=0)
    margin = 0.15 * (high - low)
    places = np.random.default_rng(seed).uniform(low + margin, high - margin, (count, 3))
    places[:, 2] = low[2] - 0.5
    return places


def test_the_nearest_user_is_the_nearest():
    users = grid(0.7)
    way = ways(0, users)
    sampling = nearest_users(users, way)
    distance = np.linalg.norm(users[None] - way[:, None], axis=2)
    np.testing.assert_array_equal(sampling.users[:, 0], distance.argmin(axis=1))
    np.testing.assert_array_equal(sampling.weights, 1.0)
    np.testing.assert_array_equal(sampling.position_m, users[sampling.users[:, 0]])
    np.testing.assert_allclose(sampling.nearest_m, distance.min(axis=1))


@settings(max_examples=50, deadline=None)
@given(st.floats(0.1, 5.0), st.integers(0, 2**32), st.floats(-0.3, 0.3), st.floats(0.0, 0.4))
def test_between_users_what_is_linear_is_exact(step, seed, shear, jitter):
    """On square, skewed and irregular grids."""
    rng = np.random.default_rng(seed)
    users = grid(step)
    users[:, 0] += shear * users[:, 1]
    users[:, :2] += jitter * step * rng.uniform(-1, 1, (len(users), 2))
    way = ways(seed, grid(step))
    way[:, 0] += shear * way[:, 1]
    sampling = surrounding_users(users, way)
    np.testing.assert_allclose(sampling.weights.sum(axis=1), 1.0, atol=1e-9)
    at = [np.linalg.matrix_rank(users[u, :2] - users[u[0], :2], tol=1e-2 * step) == 2
          for u in sampling.users]  # fmt: skip
    np.testing.assert_allclose(sampling.position_m[at, :2], way[at, :2], atol=1e-6 * step)
    np.testing.assert_allclose(sampling.position_m[:, 2], 2.0, atol=1e-9)  # where users are
    slope = rng.normal(size=2)
    linear = (sampling.weights * (users[:, :2] @ slope)[sampling.users]).sum(axis=1)
    np.testing.assert_allclose(linear, sampling.position_m[:, :2] @ slope, atol=1e-9 * step)


def test_at_a_user_it_is_that_user():
    users = grid(1.0)
    sampling = surrounding_users(users, users[[45, 210]])
    np.testing.assert_array_equal(sampling.users[:, 0], [45, 210])
    np.testing.assert_allclose(sampling.weights, [[1, 0, 0, 0]] * 2, atol=1e-6)


def test_a_line_of_users_gives_the_nearest_place_on_the_line():
    users = np.column_stack([np.arange(10.0), np.full(10, 3.0), np.full(10, 1.5)])
    sampling = surrounding_users(users, np.array([[4.3, 3.4, 1.5]]))
    np.testing.assert_allclose(sampling.position_m, [[4.3, 3.0, 1.5]], atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_fewer_users_than_neighbors_are_enough(count):
    users = grid(1.0)[:count]
    sampling = surrounding_users(users, np.array([[0.2, 0.0, 2.0]]))
    assert sampling.users.shape == (1, count)
    assert sampling.weights.sum() == pytest.approx(1.0)


def test_users_at_one_place_share_it():
    users = np.repeat(grid(1.0), 2, axis=0)
    way = ways(1, users, 50)
    sampling = surrounding_users(users, way)
    assert np.isfinite(sampling.weights).all()
    assert np.linalg.norm((sampling.position_m - way)[:, :2], axis=1).max() < 1.0
