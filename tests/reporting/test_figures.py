"""Tests that pictures can be drawn with any names in them, and that drawing is reproducible."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.image import imread

from experiments.console.options import LogArgs
from experiments.reporting.figures import (
    draw_consistency,
    draw_error_cdf,
    draw_trajectory,
)
from experiments.reporting.log_results import beginning
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.linalg import pack

AWKWARD = "a$b_{^$ | \x1b[31m <b>\n\u202eق"
T = 50
ONES = np.ones((T, 3))


def draw_track(name, path, position_m, scene=SCENES["street"], learned=(), gap=T):
    """Draw a track in which a mode of this name and another one take turns; maybe with a gap."""
    block, _ = beginning(LogArgs(sample="canyon28_pedestrian", imm="imm"), T)
    P = np.tile(pack(0.01 * np.eye(7)), (T, 1))
    mode = np.arange(T) // 20 % 2
    states = {"smooth_x": position_m, "smooth_P": P, "mode": mode, "segment": np.arange(T) // gap}
    track = replace(block, modes=[name, "ukf"], **states)
    draw_trajectory(track, position_m + 0.1, scene, path, name, learned)


def drawn(name, path):
    """Draw a picture of every kind with a name in it, and return the files."""
    walk = np.cumsum(np.random.default_rng(0).normal(size=(T, 3)), axis=0)
    errors = np.random.default_rng(1).normal(size=(4, T, 3))
    files = [path / f"{kind}.svg" for kind in ("track", "cdf", "nees")]
    draw_track(name, files[0], walk)
    draw_error_cdf({name: errors, "imm": 2.0 * errors}, files[1])
    draw_consistency(np.arange(T) * 1.0, {name: (errors**2).sum(axis=-1)}, 3, files[2])
    return files


@pytest.mark.slow
@pytest.mark.parametrize("name", ["$", "$x$", r"a\$b$", AWKWARD, "\udcff.csv"])
def test_pictures_with_any_name_are_valid_files(name, tmp_path):
    for path in drawn(name, tmp_path):
        ElementTree.parse(path)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(("offset_m", "is_drawn"), [(5.0, True), (5000.0, False)])
def test_learned_walls_are_drawn_near_the_track(tmp_path, offset_m, is_drawn):
    wall = {"normal": [0.6, 0.8], "offset_m": offset_m}
    image = {"sigma_m": [1.0, 1.0, 1.0], "wall": wall}
    walk = np.cumsum(ONES, axis=0)
    scene = replace(SCENES["street"], walls=())
    for name, learned in (("a", []), ("b", [image, image])):
        draw_track("ekf", tmp_path / f"{name}.svg", walk, scene, learned)
    without, walls = ((tmp_path / f"{name}.svg").read_text() for name in "ab")
    assert (without != walls) == is_drawn
    # three lines for each wall, and one in the legend
    assert walls.count("stroke-dasharray") - without.count("stroke-dasharray") == 7 * is_drawn


def test_names_are_shown_unchanged_except_characters_that_cannot_be_printed(tmp_path):
    names = {
        "a$b_{^$ | <b>": "a$b_{^$ | &lt;b&gt;",
        "\x1b[31m\n": r"\x1b[31m\n",
        "\udcff": r"\udcff",
    }
    draw_error_cdf(dict.fromkeys(names, ONES), tmp_path / "a.svg")
    content = (tmp_path / "a.svg").read_text()
    assert all(f">{shown}</text>" in content for shown in names.values())


def test_a_character_that_the_font_lacks_is_kept_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match="Glyph 28450 .* missing"):
        draw_error_cdf({"漢": ONES}, tmp_path / "a.svg")
    assert ">漢</text>" in (tmp_path / "a.svg").read_text("utf-8")


def cdf(path):
    """Draw a plain picture; return the content of its file."""
    draw_error_cdf({"rule": ONES}, path)
    return path.read_bytes()


@pytest.mark.parametrize(
    ("suffix", "begin"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".SVG", b"<?xml")]
)
def test_the_suffix_determines_the_format_and_equal_pictures_give_equal_files(
    tmp_path, suffix, begin
):
    first = cdf(tmp_path / f"a{suffix}")
    assert first.startswith(begin) and first == cdf(tmp_path / f"b{suffix}")


def test_matplotlib_settings_of_the_user_do_not_change_a_picture(tmp_path):
    plain = cdf(tmp_path / "a.png")
    with mpl.rc_context({"text.usetex": True, "axes.facecolor": "red"}):
        assert cdf(tmp_path / "b.png") == plain
        assert mpl.rcParams["axes.facecolor"] == "red"


def test_small_ellipses_are_enlarged_and_the_picture_says_so(tmp_path):
    still = np.zeros((T, 3))
    moving = still + np.linspace(0.0, 100.0, T)[:, None]
    for name, position in (("still", still), ("moving", moving)):
        draw_track(name, tmp_path / f"{name}.svg", position)
    assert "enlarged" not in (tmp_path / "still.svg").read_text()
    assert "enlarged" in (tmp_path / "moving.svg").read_text()


def test_the_truth_is_not_drawn_through_a_gap(tmp_path):
    draw_track("ekf", tmp_path / "gap.svg", np.cumsum(ONES, axis=0), gap=30)
    paths = re.findall(r'<path d="([^"]*)"[^>]*opacity: 0.25', (tmp_path / "gap.svg").read_text())
    truth = max(paths, key=len)  # others are in the legend
    assert truth.count("M") == 2


def test_an_error_cdf_without_vertical_errors_is_drawn(tmp_path):
    flat = np.random.default_rng(2).normal(size=(3, T, 3)) * [1.0, 1.0, 0.0]
    draw_error_cdf({"imm": flat}, tmp_path / "flat.png")
    assert (imread(tmp_path / "flat.png")[..., :3] != 1.0).any(axis=2).mean() > 0.02
