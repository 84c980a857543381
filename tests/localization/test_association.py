"""Tests of associating paths with anchors by their NIS, of where tracks begin, and of counts."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.log_folder import read_log_folder
from mmwave_env.filters.bank import default_modes
from mmwave_env.filters.textbook import tangent
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.association import PathTracker, assign, associate
from mmwave_env.localization.image_filter import Belief, Image, Paths, disagreement
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.segments import segments
from mmwave_env.logs.log import PathLog, paths_of, read_log, read_paths
from mmwave_env.logs.log_tables import LogError, Table, log_file
from mmwave_env.models.layout import Layout, sigma_name
from mmwave_env.models.prior import GAP_S
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, Scene, scene_of_anchors
from policies.rules import by_predicted_speed
from tests.filters.problems import numbers, problems
from tests.filters.tracks import drawn, geometry, wrapped
from tests.logs.by_hand import hide_anchors
from tests.paths import LOGS, representative

RADIO = RADIOS["standard"]
MODES = default_modes("standard")
# A street 20 m wide with the base station nearer to its northern wall.
SCENE = Scene("canyon", (0.0, 3.0, 8.0), virtual_anchors_m=((0.0, 17.0, 8.0), (0.0, -23.0, 8.0)))
LAYOUT = Layout(3)


NAMES = ["time_s", "range_m", "aoa_azimuth_rad", "aoa_elevation_rad", "aod_azimuth_rad"]
NAMES += ["doppler_hz", "snr_db"]
OWN = [sigma_name(name) for name in NAMES[1:6]]


def log_of(epochs, scene=SCENE, own=()):
    """Return epochs, arrays of rows, as a log of paths, all with the same deviations, if any."""
    rows = np.concatenate(list(epochs))
    cells = np.hstack([rows, np.tile(own, (len(rows), 1))])
    file = log_file(Path("log.csv"), NAMES + OWN[: len(own)], ",", scene, associated=False)
    return paths_of(Table(file, np.arange(len(rows)) + 2, cells))


def associated(paths, scene=SCENE):
    """Assign the paths of a log, or of these epochs, to anchors; return the log and the counts."""
    log = paths if isinstance(paths, PathLog) else log_of(paths)
    return associate(log, scene, RADIO, MODES[-1])


def walk(anchors_seen, false_paths=0, seed=0, y_m=-2.0):
    """Yield epochs of a user who walks east; ``anchors_seen[t]`` lists visible anchors by index."""
    rng = np.random.default_rng(seed)
    time = np.arange(len(anchors_seen), dtype=float)
    position = [20.0, y_m, 1.5] + time[:, None] * [1.4, 0.0, 0.0]
    exact = geometry(position, np.tile([1.4, 0.0, 0.0], (len(time), 1)), SCENE, LAYOUT)
    sigma = RADIO.sigma(np.full((1, 3), 25.0), SCENE, LAYOUT)
    noisy = exact + sigma * rng.standard_normal(exact.shape)
    for t, links in enumerate(anchors_seen):
        rows = noisy[t, :12].reshape(3, 4)[list(links)]
        shifts = np.full((len(rows), 1), noisy[t, 12])
        ranges = rng.uniform(2.0, 60.0, false_paths)
        angles = rng.uniform([-np.pi, -0.6, -np.pi], [np.pi, 0.2, np.pi], (false_paths, 3))
        false = np.column_stack([ranges, angles, rng.uniform(-200.0, 200.0, false_paths)])
        paths = np.concatenate([np.hstack([rows, shifts]), false])
        paths = paths[rng.permutation(len(paths))]
        rows = np.insert(paths, [0, 5], [time[t], 25.0], axis=1)
        yield np.vstack([rows, [time[t], *[np.nan] * 6]])


ALL = (0, 1, 2)
NONE = ()


def seen_in(block):
    """Return, for each epoch, the indices of the anchors to which paths were assigned."""
    return [tuple(np.flatnonzero(row[:3]).tolist()) for row in block.visible]


def ate(block, true):
    """Return the mean position error in m of a block's track; ``true`` has the true positions."""
    track = localize(block, true.scene, RADIO, Switching(MODES, by_predicted_speed), window=None)
    position_m = true.position_m[np.searchsorted(true.time_s, track.time_s)]
    return np.linalg.norm(track.x[:, :3] - position_m, axis=1).mean()


@pytest.mark.parametrize(
    "name", representative(["canyon28_vehicle", "canyon28_pedestrian"], "canyon28_vehicle")
)
def test_a_shipped_log_without_anchor_numbers_gives_nearly_the_same_track(tmp_path, name):
    track = read_log_folder(LOGS / name)
    path = tmp_path / "log.csv"
    episode = track.episode(RADIO, np.random.default_rng(0))
    hide_anchors(path, episode, false_paths=5, seed=1)
    paths = read_paths(path, track.scene)
    block, figures = associated(paths, track.scene)
    true = read_log(LOGS / name / "log.csv", track.scene).whole()
    ours = block.visible[:, :3]
    links = true.visible[:, :3]
    same = (block.measurement == true.measurement)[:, :12].reshape(-1, 3, 4).all(axis=2)
    # arrival and departure of false paths are as opposite as those of the 1,000 true ones
    assert (ours & ~(links & same)).sum() <= 1
    assert (ours & links).sum() > 0.98 * links.sum()
    assert ate(block, track) < 1.1 * ate(true, track)
    T = len(track)
    assert figures["starts"] == 1
    assert figures["associated"] == {f"anchor {a + 1}": ours[:, a].sum() for a in range(3)}
    assert figures["missed"] == {f"anchor {a + 1}": T - ours[:, a].sum() for a in range(3)}
    assert figures["false"] == figures["paths"] - ours.sum() == len(paths.table) - ours.sum()
    assert figures["without_track"] == {"epochs": 0, "paths": 0}


@pytest.mark.parametrize(
    ("blocked", "expected"), [([(1,)] * 3, [NONE] * 3), ([(1, 2)] * 20, [(1, 2)] * 20)]
)
def test_a_track_never_begins_from_a_reflection_taken_for_the_line_of_sight(blocked, expected):
    block, _ = associated(walk([*blocked, *[ALL] * 20], 2, seed=4))
    assert seen_in(block) == [*expected, *[ALL] * 20]
    assert np.flatnonzero(block.restarts).tolist() == [expected.count(NONE)]


def test_a_track_that_started_from_a_reflection_gives_way_to_the_line_of_sight():
    anchors_seen = [(1,)] * 30 + [ALL] * 20
    # The only path is from the station's image, 14 m to the north. The image is mistaken for the
    # station, so the track is 14 m too far south. Until other paths appear, nothing reveals this.
    block, figures = associated(walk(anchors_seen, seed=4, y_m=6.0))
    begins = np.flatnonzero(block.restarts).tolist()
    assert seen_in(block)[:20] == [(0,)] * 20 and begins[0] == 0
    assert len(begins) == 2 and 20 < begins[1] <= 30
    assert seen_in(block)[30:] == anchors_seen[30:] and figures["starts"] == 2
    first, second = segments(block, SCENE, RADIO)
    assert first.epochs.start == 0 and second.epochs.stop - second.epochs.start >= 20


@pytest.mark.parametrize("false_paths", [0, 5])
def test_a_new_track_begins_after_a_gap(false_paths):
    gap = int(GAP_S) + 5
    anchors_seen = [ALL] * 10 + [NONE] * gap + [(0, 2)] * 10
    block, figures = associated(walk(anchors_seen, false_paths, seed=2))
    wrong = sum(set(a) - set(b) != set() for a, b in zip(seen_in(block), anchors_seen, strict=True))
    assert wrong <= (1 if false_paths else 0)
    assert seen_in(block)[-9:] == anchors_seen[-9:]
    assert len(segments(block, SCENE, RADIO)) == figures["starts"] == 2


def test_false_paths_alone_do_not_make_a_track():
    block, figures = associated(walk([NONE] * 60, 5, seed=3))
    assert block.visible.sum() <= 5
    assert figures["without_track"]["epochs"] >= 55 and figures["paths"] == 300


def test_association_does_not_change_odometry_and_doppler_spread(tmp_path):
    episode = drawn(1, scenario="vehicle", radio="standard", epochs=40, odometry=True)
    path = tmp_path / "log.csv"
    hide_anchors(path, episode, false_paths=2)
    block, _ = associated(read_paths(path, SCENES["street"]), SCENES["street"])
    shown = block.visible[:, -1]
    assert_array_equal(shown, episode.usable[:, -1])
    assert_array_equal(block.measurement[shown, 13:], episode.measurement[shown, 13:])
    assert_array_equal(block.doppler_spread_hz, episode.doppler_spread_hz)


def test_ranges_with_their_own_deviations_are_as_uncertain_as_offsets_of_anchors():
    scene = replace(SCENE, range_offset_sigma_m=(0.4, 0.0, 0.3))
    log, _ = associated(log_of(walk([ALL] * 12), scene, own=[0.3, 0.02, 0.02, 0.03]), scene)
    expected = np.tile([0.5, 0.3, np.hypot(0.3, 0.3)], (12, 1))
    assert_allclose(log.sigma[:, LAYOUT.ranges], expected)


def test_only_the_doppler_shift_of_the_line_of_sight_is_used_with_its_own_deviation():
    log, _ = associated(log_of(walk([ALL] * 12), own=[0.3, 0.02, 0.02, 0.03, 7.0]))
    assert log.visible.all() and not log.incomplete.any() and not log.doppler_anchor.any()
    assert (log.sigma[:, LAYOUT.doppler] == 7.0).all()


def test_epochs_before_a_damaged_line_are_returned():
    damage = LogError("line 7")
    log, _ = associated(log_of(walk([ALL] * 12))._replace(damage=damage))
    assert len(log) == 12 and log.damage is damage


# --- the NIS of paths, and the best assignment


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
    tracker = PathTracker(scene, RADIO, MODES[0])
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
    assert_allclose(disagreement(paths, sigma**2), (apart / 0.05) ** 2, atol=1e-12)
