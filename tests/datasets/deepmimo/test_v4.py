"""Folders of DeepMIMO v4: static and dynamic, formats of arrays, sets, and what is refused.

Random damage is in tests/test_damaged_files.py.
"""

import os
import shutil

import numpy as np
import pytest

from mmwave_env.datasets.deepmimo import arrays, read_deepmimo
from mmwave_env.datasets.deepmimo.v4 import open_scenario
from mmwave_env.datasets.samples import source_from
from tests.datasets.deepmimo.scenarios import (
    LINK,
    SAVE,
    TRUTH,
    dynamic_twin,
    edit,
    edit_line,
    edit_params,
    load,
    set_counts,
    shortened,
)

FIELDS = ("anchors_m", "time_s", "measurement", "visible", "path_gain_db", "position_m",
          "velocity_mps")  # fmt: skip


def require_same(found, expected):
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field), field)


@pytest.fixture
def static(tmp_path):
    return shortened(tmp_path / "walk", 12)


@pytest.fixture
def dynamic(tmp_path, static):
    return dynamic_twin(static, tmp_path / "scenes")


def test_a_dynamic_scenario_of_50_scenes_is_the_same_episode_as_its_static_twin(tmp_path):
    static = shortened(tmp_path / "twin", 50)
    dynamic = dynamic_twin(static, tmp_path / "dynamic")
    require_same(read_deepmimo(dynamic), read_deepmimo(static))
    episodes = [
        source_from(folder, "standard").sample(np.random.default_rng(7))
        for folder in (static, dynamic)
    ]
    for field in ("measurement", "sigma", "visible", "snr_db", "prior_mean", "truth_position_m"):
        np.testing.assert_array_equal(*(getattr(episode, field) for episode in episodes), field)


def test_scenes_come_in_the_sorted_order_of_their_names(dynamic):
    expected = read_deepmimo(dynamic)
    names = sorted(scene.name for scene in dynamic.iterdir() if scene.is_dir())
    for number, name in enumerate(names):
        (dynamic / name).rename(dynamic / f"{'abcdefghijkl'[number]}{99 - number}")
    (dynamic / "pictures").mkdir()  # is no scene: nobody receives there
    require_same(read_deepmimo(dynamic), expected)


def test_of_several_users_in_a_dynamic_scenario_one_is_followed(tmp_path, static):
    busy = dynamic_twin(static, tmp_path / "busy", others=2)
    expected = read_deepmimo(static)
    require_same(read_deepmimo(busy, users=2), expected)
    require_same(read_deepmimo(busy, users=[2] * 12), expected)
    still = read_deepmimo(busy, users=[1] * 12, dt_s=0.1)
    np.testing.assert_array_equal(still.position_m, np.tile(load(static, "rx_pos")[0], (12, 1)))
    np.testing.assert_allclose(still.velocity_mps, 0.0, atol=1e-12)
    with pytest.raises(ValueError, match="users: found 3, expected 1 or 12, one for each scene"):
        read_deepmimo(busy)
    edit_line(busy, 3, None)
    with pytest.raises(ValueError, match="found 11, expected 12, one for each scene"):
        read_deepmimo(busy, users=2)


@pytest.mark.parametrize("suffix", sorted(SAVE))
def test_every_format_of_arrays_is_the_same_recording(tmp_path, static, suffix):
    require_same(read_deepmimo(shortened(tmp_path / "other", 12, suffix)), read_deepmimo(static))


def test_chosen_users_are_rows_of_the_whole(static):
    whole, rows = read_deepmimo(static, 1), [2, 3, 7, 11]
    part = read_deepmimo(static, 1, users=rows)
    for field in FIELDS[1:]:
        found, expected = getattr(part, field), getattr(whole, field)[rows]
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=field)


@pytest.mark.parametrize("suffix", sorted(SAVE))
def test_users_may_come_in_any_order_and_often(tmp_path, suffix):
    folder = shortened(tmp_path / "walk", 12, suffix)
    rows = [5, 5, 6, 4, 4, 11, 0]
    whole = read_deepmimo(folder, dt_s=10.0)
    part = read_deepmimo(folder, users=rows, dt_s=10.0)
    np.testing.assert_allclose(part.measurement[:, :12], whole.measurement[rows, :12], atol=1e-6)
    np.testing.assert_array_equal(part.time_s, 10.0 * np.arange(7))
    np.testing.assert_allclose(part.velocity_mps, np.gradient(part.position_m, 10.0, axis=0))


@pytest.mark.parametrize(
    ("users", "found"),
    [([0, 12], "12"), ([-1], "-1"), ([], "[]"), ([0.5], "[0.5]"), ([[1]], "[[1]]"), ([True], "")],
)
def test_users_that_there_are_not(static, users, found):
    with pytest.raises(ValueError, match="users: found") as error:
        read_deepmimo(static, users=users)
    assert found in str(error.value)


def test_a_set_of_receivers_is_chosen_by_its_number(static):
    expected = read_deepmimo(static)
    for file in list(static.glob(f"*_{LINK}.npz")):
        shutil.copy(file, static / file.name.replace("_r001", "_r002"))
    with pytest.raises(ValueError, match="receiver_set: found all, expected one of 1, 2"):
        read_deepmimo(static)
    with pytest.raises(ValueError, match="receiver_set: found 3, expected one of 1, 2"):
        read_deepmimo(static, receiver_set=3)
    require_same(read_deepmimo(static, receiver_set=2), expected)


def test_a_grid_is_known_before_its_paths_are_read(static):
    for file in static.glob("[!r]*.npz"):
        file.unlink()
    scenario = open_scenario(static)
    chosen = scenario.positions(scenario.epochs([3, 1]))
    np.testing.assert_array_equal(chosen, load(static, "rx_pos")[[3, 1]])


def test_a_grid_without_chosen_users_is_refused_before_it_is_read(tmp_path, monkeypatch):
    static = shortened(tmp_path / "grid", 12, ".npy")
    monkeypatch.setattr(arrays, "MOST_BYTES", 12 * 4 * 8)  # all paths of a key, not bounces
    with pytest.raises(ValueError, match=r"inter_pos: found 12 rows .* choose users"):
        read_deepmimo(static)


def test_names_in_the_parameters_lead_nowhere(static):
    expected = read_deepmimo(static)

    def lead_astray(params):
        for entry in params["txrx_sets"].values():
            entry["name"] = "../../../etc/passwd"
        params["scene"]["objects"] = params["rt_params"]["raytracer_name"] = "/etc/passwd"
        params["txrx_sets"]["../../secret"] = params["txrx_sets"].pop("txrx_set_0")

    edit_params(static, lead_astray)
    require_same(read_deepmimo(static), expected)


@pytest.mark.parametrize("scenes", [11, 13, 10**9, 10**30, 0, -1, 2.5, "12", True, None])
def test_a_number_of_scenes_that_there_are_not(dynamic, scenes):
    edit_params(dynamic, lambda params: params["scene"].update(num_scenes=scenes))
    with pytest.raises(ValueError, match=r"params.json: .*scene.num_scenes: found") as error:
        read_deepmimo(dynamic)
    assert str(scenes) in str(error.value)


def test_a_dynamic_scenario_that_says_it_is_static(dynamic):
    set_counts(dynamic, 1, 1)
    with pytest.raises(FileNotFoundError, match="found no rx_pos"):
        read_deepmimo(dynamic)


def in_scene(number, damage):
    return lambda folder: damage(folder / f"scene_{number:04}")


DAMAGE = {
    "two receivers once": (
        in_scene(5, lambda f: edit(f, "rx_pos", lambda a: np.tile(a, (2, 1)))),
        ["scene_0005", "rx_pos", "shape (2, 3)", "shape (1, 3)"],
    ),
    "a path short": (
        in_scene(5, lambda f: edit(f, "delay", lambda a: a[:, 1:])),
        ["scene_0005", "delay", "shape (1, 1)", "shape (1, 2)"],
    ),
    "a key missing": (
        in_scene(6, lambda f: (f / f"delay_{LINK}.npz").unlink()),
        ["scene_0006", "delay", "no such file"],
    ),
    "a NaN": (
        in_scene(7, lambda f: edit(f, "delay", lambda a: a * [np.nan, 1])),
        ["scene_0007", "delay[0, 0]", "nan"],
    ),
    "a station that moves": (
        in_scene(3, lambda f: edit(f, "tx_pos", lambda a: a + [1, 0, 0])),
        ["scene_0003", "tx_pos", "[-4.0, 4.0, 6.0]", "[-5.0, 4.0, 6.0]", "a station that stays"],
    ),
    "a scene too many": (
        lambda f: shutil.copytree(f / "scene_0003", f / "scene_0003b"),
        ["params.json", "found 12", "expected 13"],
    ),
    "a delay in milliseconds": (
        in_scene(4, lambda f: edit(f, "delay", lambda a: 1e3 * a)),
        ["scene_0004", "delay", "receiver 0"],
    ),
    "elsewhere": (
        lambda f: edit_line(f, 4, "0.2,-43,-3,1.5,10,0,0"),
        [TRUTH, "line 4, columns x, y, z", "[-43.0, -3.0, 1.5]", "receiver 0 in scene_0002"],
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_scene_that_contradicts_others_is_named(dynamic, damage):
    spoil, expected = DAMAGE[damage]
    spoil(dynamic)
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        read_deepmimo(dynamic)
    message = str(error.value)
    assert str(dynamic) in message and all(part in message for part in expected), message


IRREGULAR = {
    "pipe": os.mkfifo,
    "folder": lambda path: path.mkdir(),
    "device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("kind", IRREGULAR)
@pytest.mark.parametrize("name", [f"rx_pos_{LINK}.npz", f"delay_{LINK}.npz", "params.json", TRUTH])
def test_what_is_no_regular_file_is_refused(static, kind, name):
    (static / name).unlink()
    IRREGULAR[kind](static / name)
    refused = "no regular file|no such file|found a (FIFO|folder|device), expected"
    with pytest.raises((ValueError, OSError), match=refused):
        read_deepmimo(static)


def test_the_paths_are_those_of_the_files(static):
    scenario = open_scenario(static)
    (station,) = scenario.paths(scenario.epochs(None))
    inter = load(static, "inter")
    np.testing.assert_array_equal(station.interactions, inter)
    there = np.isfinite(inter)
    np.testing.assert_array_equal(station.delay_s[there], load(static, "delay")[there])
    zenith = np.degrees(station.arrival[there, 1])
    np.testing.assert_allclose(zenith, load(static, "aoa_el")[there], rtol=1e-12)
    assert station.source("power", 3) == (static / f"power_{LINK}.npz", 3)
