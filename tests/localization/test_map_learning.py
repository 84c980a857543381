"""Tests of learning the mirror images of a base station from paths."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from experiments.evaluation.contenders import contender_from
from mmwave_env.filters.bank import default_modes
from mmwave_env.localization.association import associate
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.map_learning import LOOK_AHEAD, MapLearner, learn_map
from mmwave_env.logs.log import read_paths
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, read_scene, scene_json
from tests.filters.tracks import drawn
from tests.logs.by_hand import hide_anchors, refuses_log
from tests.paths import representative

STREET = SCENES["street"]
STATION = replace(STREET, walls=())
ANGLES = ["aoa_elevation_rad", "aod_azimuth_rad"]
NEES_LIMIT = 7.815  # 95 % quantile of chi-square with 3 degrees of freedom


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Return the file of the latest log of paths."""
    return tmp_path_factory.mktemp("logs") / "paths.csv"


@pytest.fixture(scope="module")
def paths_of(path):
    """Return a function that makes a log of paths; it also returns the episode."""

    def make(
        seed,
        radio="standard",
        false_paths=1.0,
        scene=STATION,
        epochs=200,
        without=(),
        blocked=slice(0),  # epochs without a line of sight
    ):
        episode = drawn(seed, radio=radio, epochs=epochs)
        visible = episode.visible.copy()
        visible[blocked, 0] = False
        episode = replace(episode, visible=visible)
        hide_anchors(path, episode, false_paths, seed, without)
        return read_paths(path, scene), episode

    return make


@pytest.fixture(scope="module")
def drive(paths_of):
    """Return a function that learns from one drive, once for all tests."""
    return cache(lambda seed, radio="standard": learned([paths_of(seed, radio)[0]], radio))


def learned(logs, radio="standard", scene=STATION):
    return learn_map(logs, scene, RADIOS[radio], default_modes(radio)[-1])


def learner(radio="standard", scene=STATION):
    return MapLearner(scene, RADIOS[radio], default_modes(radio)[-1])


def scores(log, episode, radio, scene):
    """Return ATE, mean NEES and share of NEES in their 95 % from 30 s on."""
    tracker = learner(radio, scene)
    errors = []
    nees = []
    for b in tracker.follow(tracker.observed(log)):
        if b.tracked and b.time_s >= 30.0:
            error = b.x[:3] - episode.truth_position_m[np.searchsorted(episode.time_s, b.time_s)]
            errors.append(np.linalg.norm(error))
            nees.append(error @ np.linalg.solve(b.P[:3, :3], error))
    return np.mean(errors), np.mean(nees), np.mean(np.array(nees) < NEES_LIMIT)


def assert_learned(scene, most_m, axes=3):
    """Check that two images were learned, each within ``most_m`` of a true image."""
    apart = scene.anchors_m[1:, None, :axes] - STREET.anchors_m[None, 1:, :axes]
    assert len(scene.learned) == 2
    assert np.linalg.norm(apart, axis=2).min(axis=1).max() < most_m


@pytest.mark.parametrize("radio", representative(["standard", "handset"], "standard"))
def test_the_images_of_a_street_are_learned_from_one_drive(paths_of, drive, radio):
    log, _ = paths_of(1, radio)
    scene, figures = drive(1, radio)
    assert_learned(scene, 4.0)
    assert figures["epochs"] == len(log.epochs)
    assert 0.5 < figures["explained"] / figures["paths"] < 1.0


def test_an_epoch_waits_for_the_next_ones_only_where_the_track_is_doubtful(paths_of):
    log, _ = paths_of(5)
    read = []

    def arriving():
        for epoch in learner().observed(log):
            read.append(epoch.time_s)
            yield epoch

    waited = [len(read) - number for number, _ in enumerate(learner().follow(arriving()), start=1)]
    assert waited[0] == LOOK_AHEAD and max(waited) == LOOK_AHEAD
    assert waited.count(0) > len(waited) / 3


@pytest.mark.slow
def test_a_reflection_is_no_line_of_sight_if_every_second_epoch_has_a_shorter_path(paths_of):
    log, episode = paths_of(4, blocked=slice(1, None, 2))
    ate, _, _ = scores(log, episode, "standard", STATION)
    assert ate < 2.0  # it was 30 m


@pytest.mark.slow
def test_a_clock_that_is_set_back_begins_a_new_track_on_the_same_map(paths_of):
    log, episode = paths_of(5, epochs=60)
    epochs = [*learner().observed(log)]
    once = [*learner().follow(epochs)]
    twice = [*learner().follow([*epochs, *epochs])]
    assert len(twice) == 120 and any(b.begins for b in twice[60:])
    assert sum(image.paths for image in twice[-1].images) > sum(i.paths for i in once[-1].images)
    error = twice[-1].x[:3] - episode.truth_position_m[59]
    assert np.linalg.norm(error) < 3.0 and np.linalg.eigvalsh(twice[-1].P).min() > 0.0


def test_at_a_beginning_no_second_path_is_the_line_of_sight(paths_of):
    log, _ = paths_of(1, epochs=20)
    tracker = learner()
    paths = next(tracker.observed(log))
    sight = int(np.flatnonzero(paths.straight)[0])
    twice = paths.part(np.array([sight, sight]))
    prior = tracker.prior(tracker.start, twice, 0)
    begun = tracker.begun(prior, twice, 0)
    assert begun.labels == {0: 0}
    np.testing.assert_array_equal(begun.x, prior.x)


@pytest.mark.slow
@pytest.mark.parametrize("without", [["aoa_elevation_rad"], ["aod_azimuth_rad"], ANGLES])
def test_paths_without_elevation_or_departure_reveal_the_images_and_the_track(
    paths_of, path, without
):
    log, episode = paths_of(5, without=without)
    scene, figures = learned([log])
    assert 0.5 < figures["explained"] / figures["paths"] < 1.0
    assert_learned(scene, 4.0, axes=2)
    mode = default_modes("standard")[-1]
    switching = contender_from("imm-best", "standard")
    error_m = []
    for known in (scene, STREET):
        log = read_paths(path, known)
        associated, _ = associate(log, known, RADIOS["standard"], mode)
        track = localize(associated, known, RADIOS["standard"], switching, window=None)
        true = episode.truth_position_m[np.searchsorted(episode.time_s, track.time_s)]
        error = np.linalg.norm(track.x[:, :2] - true[:, :2], axis=1)
        error_m.append(error[track.time_s >= 30.0].mean())
    assert error_m[0] < 1.5 * error_m[1] < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(("radio", "most"), [("standard", 1.06), ("handset", 1.10)])
def test_the_track_is_nearly_as_good_as_with_the_known_map(paths_of, radio, most):
    unknown = []
    known = []
    for seed in range(940, 960):
        log, episode = paths_of(seed, radio)
        unknown.append(scores(log, episode, radio, STATION))
        known.append(scores(*paths_of(seed, radio, scene=STREET), radio, STREET))
    ate, nees, inside = np.mean(unknown, axis=0)
    ate_known, nees_known, _ = np.mean(known, axis=0)
    assert ate < most * ate_known
    assert nees < nees_known + 1.5
    assert inside > 0.9


@pytest.mark.parametrize("seed", representative([2, 3, 4], 2))
def test_learning_goes_on_with_the_next_log(paths_of, drive, tmp_path, seed):
    scene, _ = drive(seed)
    file = tmp_path / "learned.json"
    file.write_text(json.dumps(scene_json(scene)))
    stored = read_scene(file)
    assert stored.learned == scene.learned
    second, _ = paths_of(seed + 100, scene=stored)
    again, _ = learned([second], scene=stored)
    assert_learned(again, 2.0)
    assert min(i.paths for i in again.learned) > max(i.paths for i in stored.learned) / 2
    total = sum(image.paths for image in again.learned)
    assert total > 1.5 * sum(image.paths for image in stored.learned)


@pytest.mark.parametrize("moved_m", [(0.0, 3.0, 0.0), (300.0, 300.0, 0.0)])
def test_a_map_whose_base_station_moved_is_refused(paths_of, drive, moved_m):
    scene, _ = drive(2)
    station = tuple(np.add(STATION.base_station_m, moved_m).tolist())
    with refuses_log("learned"):
        learned([paths_of(102)[0]], scene=replace(scene, base_station_m=station))


def test_two_logs_are_learned_in_order(paths_of, drive):
    logs = [paths_of(seed)[0] for seed in (2, 102)]
    scene, figures = learned(logs)
    single, _ = drive(2)
    assert figures["epochs"] == sum(len(log.epochs) for log in logs) and figures["starts"] >= 2
    assert sum(i.paths for i in scene.learned) > 1.5 * sum(i.paths for i in single.learned)


@pytest.mark.slow
def test_paths_that_a_receiver_reports_twice_make_no_image_at_the_base_station(paths_of, path):
    paths_of(2)
    header, *rows = path.read_text().splitlines()
    path.write_text("\n".join([header, *(row for row in rows for _ in range(2))]))
    scene, _ = learned([read_paths(path, STATION)])
    assert_learned(scene, 2.0)


def test_known_images_are_not_learned_again(paths_of):
    log, _ = paths_of(1, scene=STREET)
    scene, _ = learned([log], scene=STREET)
    assert scene == STREET


def test_learned_images_have_the_range_offset_of_their_base_station(paths_of):
    station = replace(STATION, range_offset_m=(0.5,), range_offset_sigma_m=(0.1,))
    log, _ = paths_of(1, scene=station)
    scene, _ = learned([log], scene=station)
    assert scene.range_offset_m == (0.5,) * 3 and scene.range_offset_sigma_m == (0.1,) * 3


@pytest.mark.slow
def test_the_map_outlives_a_gap(paths_of):
    log, _ = paths_of(1)
    kept = np.flatnonzero((log.time_s < 120.0) | (log.time_s >= 150.0))
    epochs = [log.epochs[epoch] for epoch in kept]
    scene, figures = learned([log._replace(time_s=log.time_s[kept], epochs=epochs)])
    assert figures["starts"] >= 2
    assert_learned(scene, 2.0)


def test_false_paths_alone_make_no_map_and_are_refused(paths_of):
    log, _ = paths_of(1, false_paths=3.0)
    links = log.links.copy()
    links[:, [1, 3]] = np.random.default_rng(0).uniform(-np.pi, np.pi, (len(links), 2))
    with refuses_log("log 1 of 1"):
        learned([log._replace(links=links)])


def test_a_wall_is_halfway_between_the_station_and_its_image(drive):
    _, figures = drive(1)
    images = figures["images"]
    assert [image["anchor"] for image in images] == [2, 3]
    walls = sorted((image["wall"] for image in images), key=lambda wall: wall["offset_m"])
    for wall, true in zip(walls, sorted(STREET.walls, key=lambda w: w.offset_m), strict=True):
        np.testing.assert_allclose(wall["normal"], true.unit_normal, atol=0.05)
        assert wall["offset_m"] == pytest.approx(true.offset_m, abs=2.0)
