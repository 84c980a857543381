"""Tests that the NIS of paths equals the textbook value, and that anchors get the best paths."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.textbook import tangent
from mmwave_env.localization.association import PathTracker, assign
from mmwave_env.localization.image_filter import Belief, Image, Paths, disagreement
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import scene_of_anchors
from tests.filters.problems import numbers, problems
from tests.filters.tracks import wrapped


@settings(max_examples=30)
@given(problem=problems(anchors=3), data=st.data())
def test_the_nis_of_a_path_equals_the_textbook_value(problem, data):
    n = data.draw(st.integers(0, 4))
    links = problem.sensor.links
    predicted = tangent(problem.sensor, problem.x, problem.P)
    offset = data.draw(numbers(-0.3, 0.3, (n, 4)))
    paths = predicted.mean[np.arange(n)[:, None] % links * 4 + np.arange(4)] + offset
    paths[:, 1:] = wrapped(paths[:, 1:])
    variance = np.tile(problem.R[:8].reshape(2, 4), (n, 1, 1))
    _, *images = problem.sensor.anchors
    P = np.pad(problem.P, (0, 3 * len(images)))
    x = np.append(problem.x, images)
    belief = Belief(x, P, (Image(exact=True),) * len(images), 0.0)
    unknown = np.full(n, np.nan)
    observed = Paths(0.0, paths, unknown, variance, unknown, unknown > 0.0, False)
    scene = scene_of_anchors("problem", np.array(problem.sensor.anchors), 28e9, 400e6)
    tracker = PathTracker(scene, RADIOS["standard"], default_modes("standard")[0])
    nis, _ = tracker.nis(belief, observed)
    assert nis.shape == (links, n)
    for link, path in np.ndindex(nis.shape):
        rows = slice(4 * link, 4 * link + 4)
        whole = predicted.mean.copy()
        whole[rows] = paths[path]
        innovation = problem.sensor.difference(whole, predicted.mean)[rows]
        S = predicted.S[rows, rows] + np.diag(variance[path, min(link, 1)])
        right = innovation @ np.linalg.solve(S, innovation)
        assert nis[link, path] == pytest.approx(right, rel=1e-6, abs=1e-9)


@given(st.data())
def test_no_other_assignment_is_better(data):
    anchors = data.draw(st.integers(1, 4))
    n = data.draw(st.integers(0, 4))
    elements = numbers(0.0, 30.0) | st.just(np.inf)
    nis = data.draw(hnp.arrays(float, (anchors, n), elements=elements))
    gate = 13.3
    assigned = assign(nis, gate)
    assert len(set(assigned.values())) == len(assigned)

    def cost(chosen):
        """Return the cost of an assignment; an anchor without a path costs as much as the gate."""
        kept = [nis[a, p] for a, p in enumerate(chosen) if p < n and nis[a, p] < gate]
        return sum(kept) + gate * (anchors - len(kept))

    best = min(map(cost, permutations(range(n + anchors), anchors)))
    assert cost([assigned.get(anchor, n) for anchor in range(anchors)]) == pytest.approx(best)


def test_the_azimuths_of_a_path_disagree_if_departure_is_not_opposite_to_arrival():
    sigma = np.tile([0.2, 0.03, 0.01, 0.04], (4, 1))
    arrivals = np.array([1.0, 3.0, -3.1, -0.75 * np.pi])
    apart = np.array([0.0, 0.1, -0.05, -0.02])
    departures = wrapped(arrivals + apart - np.pi)
    paths = np.column_stack([np.full(4, 9.0), arrivals, np.full(4, 0.1), departures])
    np.testing.assert_allclose(disagreement(paths, sigma**2), (apart / 0.05) ** 2, atol=1e-12)
