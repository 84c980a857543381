"""Tests of reading DeepMIMO v4 folders: scenes, formats of arrays, sets of receivers, refusals.

A dynamic scenario has a sub-folder (a scene) for each epoch. A static scenario has a single
scene, whose receivers are the epochs. tests/test_damaged_files.py tests random damage.
"""

import os
import shutil

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.deepmimo import read_deepmimo
from tests.datasets.deepmimo.scenarios import (
    LINK,
    TRUTH,
    dynamic_twin,
    edit,
    edit_params,
    load,
    set_counts,
    shortened,
)
from tests.filters.tracks import assert_same_fields
from tests.refusals import refuses

FIELDS = ("time_s", "measurement", "visible", "path_gain_db", "position_m", "velocity_mps")


def require_same(recording, expected):
    assert_same_fields(recording, expected, *FIELDS, "anchors_m")


@pytest.fixture
def static(tmp_path):
    return shortened(tmp_path / "walk", 12)


@pytest.fixture
def dynamic(tmp_path, static):
    return dynamic_twin(static, tmp_path / "scenes")


def test_a_dynamic_scenario_gives_the_same_recording_as_its_static_twin(tmp_path):
    static = shortened(tmp_path / "twin", 50)
    require_same(read_deepmimo(dynamic_twin(static, tmp_path / "dynamic")), read_deepmimo(static))


def test_scenes_are_sorted_by_their_names(dynamic):
    expected = read_deepmimo(dynamic)
    names = sorted(scene.name for scene in dynamic.iterdir() if scene.is_dir())
    for number, name in enumerate(names):
        (dynamic / name).rename(dynamic / f"{'abcdefghijkl'[number]}{99 - number}")
    (dynamic / "pictures").mkdir()  # not a scene: it has no receivers
    require_same(read_deepmimo(dynamic), expected)


def test_one_of_several_users_in_a_dynamic_scenario_can_be_chosen(tmp_path, static):
    busy = dynamic_twin(static, tmp_path / "busy", others=2)
    expected = read_deepmimo(static)
    require_same(read_deepmimo(busy, users=2), expected)
    require_same(read_deepmimo(busy, users=[2] * 12), expected)
    still = read_deepmimo(busy, users=[1] * 12, dt_s=0.1)
    assert_array_equal(still.position_m, np.tile(load(static, "rx_pos")[0], (12, 1)))
    assert_allclose(still.velocity_mps, 0.0, atol=1e-12)
    with refuses("users"):
        read_deepmimo(busy)


def test_users_can_be_chosen_in_any_order_and_repeatedly(static):
    rows = [5, 5, 6, 4, 4, 11, 0]
    whole = read_deepmimo(static, dt_s=10.0)
    part = read_deepmimo(static, users=rows, dt_s=10.0)
    assert_allclose(part.measurement[:, :12], whole.measurement[rows, :12], atol=1e-6)
    assert_array_equal(part.time_s, 10.0 * np.arange(7))
    assert_allclose(part.velocity_mps, np.gradient(part.position_m, 10.0, axis=0))


@pytest.mark.parametrize("users", [[0, 12], [-1], [], [0.5]])
def test_users_that_do_not_exist_are_refused(static, users):
    with refuses("users"):
        read_deepmimo(static, users=users)


def test_a_set_of_receivers_is_chosen_by_its_number(static):
    expected = read_deepmimo(static)
    for file in list(static.glob(f"*_{LINK}.npz")):
        shutil.copy(file, static / file.name.replace("_r001", "_r002"))
    for number in (None, 3):
        with refuses("receiver_set"):
            read_deepmimo(static, receiver_set=number)
    require_same(read_deepmimo(static, receiver_set=2), expected)


@pytest.mark.parametrize("scenes", [11, 10**30, -1, "12"])
def test_a_wrong_number_of_scenes_is_refused(dynamic, scenes):
    edit_params(dynamic, lambda params: params["scene"].update(num_scenes=scenes))
    with refuses("params.json", "scene.num_scenes"):
        read_deepmimo(dynamic)


def array_in(number, key, change):
    return lambda folder: edit(folder / f"scene_{number:04}", key, change)


DAMAGE = {  # name -> (function that damages a folder, files and keys that the refusal names)
    "claims to be static": (lambda folder: set_counts(folder, 1, scenes=1), []),
    "two receivers": (array_in(5, "rx_pos", lambda a: np.tile(a, (2, 1))), ["0005", "rx_pos"]),
    "a key missing": (lambda f: (f / f"scene_0006/delay_{LINK}.npz").unlink(), ["0006/delay"]),
    "a NaN": (array_in(7, "delay", lambda a: a * [np.nan, 1]), ["scene_0007", "delay[0, 0]"]),
    "a station that moves": (array_in(3, "tx_pos", lambda a: a + [1, 0, 0]), ["0003", "tx_pos"]),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_scene_that_contradicts_the_other_scenes_is_named(dynamic, damage):
    spoil, parts = DAMAGE[damage]
    spoil(dynamic)
    with refuses(dynamic, *parts, error=(ValueError, FileNotFoundError)):
        read_deepmimo(dynamic)


@pytest.mark.parametrize("name", [f"delay_{LINK}.npz", "params.json", TRUTH])
def test_a_pipe_instead_of_a_file_is_refused(static, name):
    (static / name).unlink()
    os.mkfifo(static / name)
    with refuses(name, error=(ValueError, OSError)):
        read_deepmimo(static)
