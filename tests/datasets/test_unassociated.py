"""Episodes as logs of paths: nothing is lost, and nothing tells which path is whose."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from mmwave_env.datasets.log_writer import log_columns, write_log
from mmwave_env.datasets.unassociated import path_columns
from mmwave_env.logs.log import read_log
from mmwave_env.logs.path_log import read_paths
from mmwave_env.models.measurement import exact_rows
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource

SCENE, T, L, DOPPLER = SCENES["street"], 60, 3, 12


@lru_cache
def episode(odometry=False):
    source = SimulatedSource(SCENE, RADIOS["standard"], "vehicle", epochs=T, odometry=odometry)
    return source.sample(np.random.default_rng(5))


def paths(folder, one, false_paths=0, seed=0):
    path = folder / "log.csv"
    write_log(path, one, associated=False, false_paths=false_paths, seed=seed)
    return list(read_paths(path, SCENE))


def test_every_usable_link_is_a_path(tmp_path):
    one, found = episode(odometry=True), paths(tmp_path, episode(odometry=True))
    for t, epoch in enumerate(found):
        links = one.measurement[t, :DOPPLER].reshape(L, 4)[one.usable[t, :L]]
        order, theirs = np.argsort(links[:, 0]), np.argsort(epoch.measurement[:, 0])
        np.testing.assert_allclose(epoch.measurement[theirs, :4], links[order], rtol=1e-12)
        np.testing.assert_array_equal(epoch.snr_db[theirs], one.snr_db[t, one.usable[t, :L]][order])
        assert epoch.time_s == one.time_s[t] and epoch.doppler_spread_hz == one.doppler_spread_hz[t]
        if one.usable[t, -1]:
            np.testing.assert_array_equal(epoch.odometry, one.measurement[t, DOPPLER + 1 :])


def test_an_epoch_without_a_path_stays(tmp_path):
    visible = episode().visible.copy()
    visible[[0, 7, T - 1]] = False
    found = paths(tmp_path, replace(episode(), visible=visible))
    assert len(found) == T and [len(found[t].snr_db) for t in (0, 7, T - 1)] == [0, 0, 0]


def test_false_paths_come_on_top_and_look_like_others(tmp_path):
    true, found = paths(tmp_path, episode()), paths(tmp_path, episode(), false_paths=4, seed=9)
    assert all(len(b.snr_db) == len(a.snr_db) + 4 for a, b in zip(true, found, strict=True))
    real, all_of_them = (np.concatenate([e.measurement for e in some]) for some in (true, found))
    for column in (0, 2, 4):  # range, elevation, Doppler shift
        ends = np.nanmin(real[:, column]), np.nanmax(real[:, column])
        assert ((all_of_them[:, column] >= ends[0]) & (all_of_them[:, column] <= ends[1])).all()
    assert np.isfinite(all_of_them).mean() > 0.98  # an own path lacks its shift now and then


def test_order_tells_nothing_and_is_the_seeds(tmp_path):
    one, again, other = (
        [e.measurement for e in paths(tmp_path, episode(), 2, seed)] for seed in (1, 1, 2)
    )
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(one, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))
    whole = [t for t in range(T) if episode().usable[t, :L].all()]
    sight = [int(np.argmin(abs(one[t][:, 0] - episode().measurement[t, 0]))) for t in whole]
    assert len(set(sight)) == 5


def test_doppler_shifts_of_all_paths_have_one_offset(tmp_path):
    one, layout = episode(), episode().layout
    position, velocity = list(one.truth_position_m.T), list(one.truth_velocity_mps.T)
    exact = [
        exact_rows(position, velocity, [anchor], one.hz_per_mps, layout)[4]
        for anchor in one.scene_anchors_m.tolist()
    ]
    columns = path_columns(log_columns(one), one, 0, 0)
    for t in np.flatnonzero(one.usable[:, : L + 1].all(axis=1)):
        rows = columns["time_s"] == one.time_s[t]
        order = np.argsort(columns["toa_s"][rows])
        anchors = np.argsort(one.measurement[t, :DOPPLER:4])
        shifts = np.array(exact)[anchors, t] + one.measurement[t, DOPPLER] - exact[0][t]
        np.testing.assert_allclose(columns["doppler_hz"][rows][order], shifts)


def test_what_makes_no_sense_is_refused(tmp_path):
    path, one = tmp_path / "log.csv", episode()
    with pytest.raises(ValueError, match="false_paths: found -1, expected at least 0"):
        write_log(path, one, associated=False, false_paths=-1)
    with pytest.raises(ValueError, match="false_paths: found 3 among rows with anchors, expected"):
        write_log(path, one, false_paths=3)
    with pytest.raises(ValueError, match="found no truth"):
        write_log(path, replace(one, truth_position_m=None), associated=False)
    write_log(path, one, associated=False)
    with pytest.raises(ValueError, match=r"found no anchor in .*expected anchor; .* --associate"):
        read_log(path, SCENE)
