"""Tests that a path's NIS equals the textbook value, and that the best assignment is found."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mmwave_env.filters.textbook import tangent
from mmwave_env.localization.path_tracker import NO_PATH, assign, disagreement, path_nis
from tests.filters.problems import numbers, problems


@settings(deadline=None, max_examples=30)
@given(problem=problems(anchors=3), data=st.data())
def test_the_nis_of_a_path_equals_the_textbook_value(problem, data):
    n, links = data.draw(st.integers(0, 4)), problem.sensor.links
    predicted = tangent(problem.sensor, problem.x, problem.P)
    offset = data.draw(numbers(-0.3, 0.3, (n, 4)))
    paths = predicted.mean[np.arange(n)[:, None] % links * 4 + np.arange(4)] + offset
    paths[:, 1:] = (paths[:, 1:] + np.pi) % (2 * np.pi) - np.pi
    sigma = np.sqrt(problem.R[: 4 * links]).reshape(links, 1, 4).repeat(n, axis=1)
    nis = path_nis(
        problem.x.tolist(),
        problem.P.tolist(),
        problem.sensor.anchors.tolist(),
        np.stack([paths] * links),
        sigma,
    )
    assert nis.shape == (links, n)
    for link, path in np.ndindex(nis.shape):
        rows = slice(4 * link, 4 * link + 4)
        whole = predicted.mean.copy()
        whole[rows] = paths[path]
        innovation = problem.sensor.difference(whole, predicted.mean)[rows]
        S = predicted.S[rows, rows] + np.diag(sigma[link, path] ** 2)
        right = innovation @ np.linalg.solve(S, innovation)
        assert nis[link, path] == pytest.approx(right, rel=1e-6, abs=1e-9)


@settings(deadline=None)
@given(st.data())
def test_no_other_assignment_is_better(data):
    anchors, n = data.draw(st.integers(1, 4)), data.draw(st.integers(0, 4))
    elements = numbers(0.0, 30.0) | st.just(np.inf)
    nis, gate = data.draw(hnp.arrays(float, (anchors, n), elements=elements)), 13.3
    assigned = assign(nis, gate)
    taken = assigned[assigned != NO_PATH]
    assert len(set(taken.tolist())) == len(taken)

    def cost(chosen):
        """Return the cost of an assignment; an anchor without a path costs as much as the gate."""
        kept = [nis[a, p] for a, p in enumerate(chosen) if p < n and nis[a, p] < gate]
        return sum(kept) + gate * (anchors - len(kept))

    best = min(map(cost, permutations(range(n + anchors), anchors)))
    assert cost(np.where(assigned == NO_PATH, n, assigned)) == pytest.approx(best)


def test_a_path_disagrees_if_its_departure_is_not_opposite_to_its_arrival():
    sigma = np.tile([0.2, 0.03, 0.01, 0.04], (3, 1))
    paths = np.array(
        [[9.0, 1.0, 0.1, 1.0 - np.pi], [9.0, 3.0, 0.1, 0.1 + 3.0 - np.pi], [9.0, -3.1, -1.5, 0.05]]
    )
    right = [0.0, 0.1**2 / 0.05**2, (-3.1 + np.pi - 0.05) ** 2 / 0.05**2]
    np.testing.assert_allclose(disagreement(paths, sigma), right, atol=1e-12)
