"""Tests that logs that lack some measured quantities yield the tracks of a textbook EKF."""

import numpy as np
import pandas as pd
import pytest

from mmwave_env.filters import textbook
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.textbook import Sensor, tangent
from mmwave_env.interface.policy import Switching
from mmwave_env.localization.localizer import localize
from mmwave_env.localization.tracker import Tracker
from mmwave_env.models.layout import wrapped
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import scene_of_anchors
from policies import load
from tests.filters.tracks import nees_of, process_noise, unpacked
from tests.logs.by_hand import read
from tests.paths import representative

ANCHORS = np.array([[0.0, 0.0, 10.0], [0.0, 70.0, 10.0], [-90.0, 0.0, 12.0], [60.0, -50.0, 8.0]])
ROWS = {  # column -> row in a link (4: the Doppler shift), unit, standard deviation in this unit
    "range": (0, "m", 0.3),
    "aoa_azimuth": (1, "deg", 1.0),
    "aoa_elevation": (2, "deg", 1.0),
    "aod_azimuth": (3, "deg", 2.0),
    "doppler": (4, "hz", 25.0),
}
RANGE_AZIMUTH = ("range", "aoa_azimuth")
ANGLES = ("aoa_azimuth", "aoa_elevation", "aod_azimuth")
# A single anchor with neither elevations nor a known height is left out: the EKF diverges.
RECEIVERS = {  # name -> columns that are measured, time step in s, number of anchors
    "all, 1 s": (tuple(ROWS), 1.0, 3),
    "all, 0.1 s": (tuple(ROWS), 0.1, 3),
    "all, one anchor": (tuple(ROWS), 0.5, 1),
    "range and azimuth, one anchor, known height": (RANGE_AZIMUTH, 0.5, 1),
    "range and azimuth, four anchors": (RANGE_AZIMUTH, 0.2, 4),
    "range and both azimuths": ((*RANGE_AZIMUTH, "aod_azimuth"), 0.5, 2),
    "no Doppler shift": ((*ANGLES, "range"), 0.25, 3),
    "angles": (ANGLES, 0.5, 3),
    "range and elevation, four anchors": (("range", "aoa_elevation"), 1.0, 4),
    "range, azimuth and Doppler shift": ((*RANGE_AZIMUTH, "doppler"), 0.1, 2),
}
MODE = Mode("plain", gate=None, adaptive=False, recovery=None, sigma_v=0.3, sigma_vz=0.005)
RADIO = RADIOS["standard"]
GUIDED = load("guided")
WALKS = 8
EPOCHS = 120
SETTLED = 20  # number of first epochs whose errors are not compared


def noise(dt, hz_per_mps, flat):
    """Return the process noise Q (7, 7) of a step with MODE's tuning."""
    Q = process_noise(MODE, dt, hz_per_mps=hz_per_mps)
    if flat:
        Q[[2, 5]] = Q[:, [2, 5]] = 0.0
    return Q


def write_log(path, scene, states, dt, measured, rng, share=0.9):
    """Write a log of a user with these states (7,), with a share of its values."""
    sensor = Sensor(scene.anchors_m, scene.hz_per_mps)
    anchors = len(scene.anchors_m)
    sigmas = {f"{name}_sigma_{ROWS[name][1]}": ROWS[name][2] for name in measured}
    rows = []
    for epoch, x in enumerate(states):
        exact = sensor.h(x)
        for anchor in range(anchors):
            row = {"time_s": epoch * dt, "anchor": anchor + 1, **sigmas}
            for name in measured:
                place, unit, sigma = ROWS[name]
                value = exact[4 * anchors if place == 4 else 4 * anchor + place]
                value = np.degrees(wrapped(value)) if unit == "deg" else value
                if rng.random() < share and (place < 4 or not anchor):
                    noisy = value + sigma * rng.standard_normal()
                    row[f"{name}_{unit}"] = max(noisy, -90.0) if place == 2 else noisy
            rows.append(row)
    pd.DataFrame(rows).to_csv(path, index=False)


def walk(path, receiver, seed):
    """Write a log of a user who moves as the filter assumes; return scene and true positions."""
    measured, dt, anchors = RECEIVERS[receiver]
    scene = scene_of_anchors("receiver", ANCHORS[:anchors], 28e9, 100e6)
    rng = np.random.default_rng(seed)
    Q = noise(dt, scene.hz_per_mps, "height" in receiver)
    truth = []

    def states():
        x = np.array([25.0, 30.0, 1.5, *rng.uniform(0.1, 0.8, 2), 0.0, rng.normal(0.0, 50.0)])
        for _ in range(EPOCHS):
            truth.append(x[:3])
            yield x
            x = rng.multivariate_normal(textbook.F(dt) @ x, Q)

    write_log(path, scene, states(), dt, measured, rng)
    return scene, np.array(truth)


def by_textbook(log, scene, x, P, flat):
    """Run a textbook EKF on a log, starting from a belief (x, P); return the means (T, 3)."""
    sensor = Sensor(scene.anchors_m, scene.hz_per_mps)
    means = [x[:3]]
    for t in range(1, len(log)):
        dt = log.time_s[t] - log.time_s[t - 1]
        z = log.measurement[t]
        x, P = textbook.predict(x, P, noise(dt, scene.hz_per_mps, flat), dt)
        keep = np.isfinite(z)
        R = np.where(keep, log.sigma[t], 1.0) ** 2
        x, P = textbook.update(tangent, sensor, x, P, np.where(keep, z, 0.0), R, keep)
        means.append(x[:3])
    return np.array(means)


# Quick cases have three anchors; any other number of anchors needs new compiled programs.
@pytest.mark.parametrize(
    "receiver", representative(RECEIVERS, "all, 1 s", "no Doppler shift", "angles")
)
def test_a_track_equals_the_track_of_a_textbook_ekf_and_is_consistent(tmp_path, receiver):
    nees = []
    flat = "height" in receiver
    height_m, axes = (1.5, 2) if flat else (None, 3)
    for seed in range(WALKS):
        scene, truth = walk(tmp_path / "log.csv", receiver, seed)
        log = read(tmp_path / "log.csv", scene)
        track = localize(log, scene, RADIO, Switching((MODE,)), window=None, height_m=height_m)
        begins = EPOCHS - len(track)
        first = track.x[0], unpacked(track.P[0])
        plain = by_textbook(log.part(slice(begins, None)), scene, *first, flat)
        np.testing.assert_allclose(track.x[:, :3], plain, atol=1e-6)
        error = track.x[:, :axes] - truth[begins:, :axes]
        nees.append(nees_of(error[SETTLED:], track.P[SETTLED:]).mean())
    assert np.mean(nees) == pytest.approx(axes, rel=0.15)


def test_a_user_who_stands_below_an_anchor_and_walks_away_is_localized_by_all(tmp_path):
    scene = scene_of_anchors("room", ANCHORS[:3] / [15.0, 15.0, 4.0], 28e9, 100e6)
    nees = []
    for seed in range(3 * WALKS):
        rng = np.random.default_rng(seed)
        states = np.zeros((40, 7))
        states[:, :3] = [*rng.normal(0.0, 0.1, 2), 1.0]
        turn = rng.uniform(0.0, 2.0 * np.pi)
        states[20:, :2] += 1.2 * np.outer(np.arange(20), [np.cos(turn), np.sin(turn)])
        write_log(tmp_path / "log.csv", scene, states, 1.0, (*ANGLES, "range"), rng, 1.0)
        log = read(tmp_path / "log.csv", scene)
        track = localize(log, scene, RADIO, GUIDED)
        assert len(track) == 40
        nees.append(nees_of(track.smooth_x[:, :3] - states[:, :3], track.smooth_P).mean())
    assert np.median(nees) < 4.0
    tracker = Tracker(scene, GUIDED, RADIO)
    epochs = pd.read_csv(tmp_path / "log.csv").groupby("time_s")
    live = [tracker.update(rows.to_dict("records")).position_m for _, rows in epochs]
    filtered = localize(log, scene, RADIO, GUIDED, window=None).x
    np.testing.assert_array_equal(live, filtered[:, :3])
