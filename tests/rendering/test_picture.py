"""Tests of pictures of episodes: what they show, and which part of the map is in the frame."""

import copy
import pickle
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pygame
import pytest
from numpy.testing import assert_array_equal

from mmwave_env.env import MmWaveLocEnv
from mmwave_env.models.scene import Scene, Streets, Wall
from mmwave_env.rendering.canvas import Rect
from mmwave_env.rendering.history import NO_MODE, History
from mmwave_env.rendering.picture import draw_picture
from mmwave_env.rendering.street_map import follow
from mmwave_env.rendering.theme import THEMES
from tests.refusals import refuses

ID = "mmwave_env:MmWaveLoc-v0"
LIGHT = THEMES["light"]
GROUPS = 4
NOTHING = np.zeros(GROUPS, bool)
every_theme = pytest.mark.parametrize("theme", THEMES)


def near(picture, color):
    """Return a mask of the pixels that have about this color (edges are smoothed)."""
    return (abs(picture.astype(int) - color) < 12).all(axis=-1)


HERE = ((0.0, 0.0),)


def history(truth=HERE, estimate=HERE, modes=(0,), accepted=NOTHING, rejected=NOTHING, **scenery):
    """Return a history: the prior, then an epoch for each point of ``truth``, a second apart."""
    scenery = {"name": "test", "anchors": [(200.0, 150.0, 10.0)], "scene": None} | scenery

    def states(points, size):
        filled = np.zeros((len(points) + 1, size))
        filled[1:, :2] = points
        filled[0, :2] = points[0]
        return filled

    rows = len(truth) + 1
    P = np.tile([0.01, 0.0, 0.01, 0.0, 0.0, 0.01], (rows, 1))
    place = scenery["name"], np.array(scenery["anchors"]), scenery["scene"]
    time = np.maximum(0.0, np.arange(rows) - 1.0)
    ran = np.array([NO_MODE, *modes])
    gates = (np.tile(groups, (rows, 1)) for groups in (accepted, rejected))
    beliefs = states(truth, 6), states(estimate, 7), P, np.full(rows, 3.0)
    return History(*place, 3, time, ran, *beliefs, *gates)


def drawn(**arguments):
    return draw_picture(history(**arguments), ["ekf", "ukf"])


def played(steps, seed=0, **arguments):
    env = gym.make(ID, render_mode="rgb_array", **arguments)
    env.reset(seed=seed)
    for k in range(steps):
        env.step(k % 2)
    return env


def test_the_first_picture_shows_the_prior_and_the_user():
    env = played(0)
    first = env.render()
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8
    assert near(first, LIGHT.truth)[20:280].sum() > 20  # the user; the prior is gray
    assert near(first, LIGHT.quiet)[20:280].sum() > 20
    env.step(1)
    assert (env.render() != first).any()


@pytest.mark.parametrize("size", [480, 1080])
@every_theme
def test_a_picture_has_the_chosen_size_and_theme(size, theme):
    picture = played(3, render_size=size, render_theme=theme).render()
    assert picture.shape == (size, size, 3)
    assert near(picture, THEMES[theme].paper).mean() > 0.1


def test_accepted_links_are_solid_rejected_links_dashed_and_missing_links_faint():
    first = np.eye(GROUPS, dtype=bool)[0]
    contrast = {}
    kinds = {"accepted": {"accepted": first}, "rejected": {"rejected": first}}
    for kind, gates in {**kinds, "missing": {}}.items():
        picture = drawn(anchors=[(200.0, 0.0, 10.0)], **gates).astype(int)
        link = picture[140:160, 260:360]  # east of the user
        contrast[kind] = abs(link - LIGHT.ground).max(axis=(0, 2))
        orange = (link[..., 0] - link[..., 2] > 60).any()
        assert orange == (kind == "rejected")
    assert contrast["accepted"].min() > 40
    assert contrast["rejected"].max() > 40 and contrast["rejected"].min() < 5
    assert 5 < contrast["missing"].min() and contrast["missing"].max() < 40


def test_the_trail_has_the_color_of_the_mode_that_ran():
    route = [(2.0 * k, 0.0) for k in range(10)]
    beside = [(x, 4.0) for x, _ in route]
    single = drawn(truth=route, estimate=beside, modes=[0] * 10)[20:280]
    both = drawn(truth=route, estimate=beside, modes=[0] * 5 + [1] * 5)[20:280]
    blue, orange = LIGHT.modes[:2]
    assert near(single, blue).sum() > 100 and not near(single, orange).any()
    left = np.nonzero(near(both, blue))[1].mean()
    right = np.nonzero(near(both, orange))[1].mean()
    assert left < right


def test_the_estimate_is_drawn_at_its_position():
    picture = drawn(estimate=[(10.0, 10.0)], modes=[1])[80:220, 160:320]
    rows, columns = np.nonzero(near(picture, LIGHT.modes[1]))
    user = np.argwhere(near(picture, LIGHT.truth)).mean(axis=0)
    assert rows.mean() < user[0] and columns.mean() > user[1]  # north-east of the user


def test_walls_are_drawn_only_where_the_scene_has_some():
    gnb = (0.0, 10.0, 10.0)
    anchors = [gnb, (20.0, 10.0, 10.0)]  # of the same height, so the second may be an image
    walled = drawn(anchors=anchors, scene=Scene("test", gnb, (Wall((-2.0, 0.0), -10.0),)))
    wall = near(walled[20:280], LIGHT.wall)
    column = int(np.argmax(wall.sum(axis=0)))
    assert wall[:, column].sum() > 200  # from top to bottom
    assert 250 < column < 400  # 10 m east of the user
    masts = near(drawn(anchors=anchors, scene=Scene("test", gnb))[20:280], LIGHT.wall)
    assert masts.sum(axis=0).max() < 100


def test_streets_are_drawn_if_they_are_known():
    streets = Streets((-80.0, 80.0), (-80.0, 80.0), 80.0)
    with_streets = drawn(scene=Scene("test", (200.0, 150.0, 10.0), streets=streets))[20:280]
    without = drawn()[20:280]
    assert near(with_streets, LIGHT.building).mean() > 0.3
    assert near(without, LIGHT.building).mean() < 0.02  # smoothed edges of other shapes


OUTSIDE = {"east": (500.0, 0.0), "west": (-500.0, 3.0), "north": (0.0, 900.0), "south": (2.0, -1e7)}


@pytest.mark.parametrize(("side", "anchor"), OUTSIDE.items())
def test_an_anchor_outside_the_frame_is_shown_at_its_edge(anchor, side):
    picture = drawn(anchors=[(*anchor, 10.0)])
    strips = {"east": picture[20:262, 455:], "west": picture[20:262, :25]}
    strips |= {"north": picture[20:45], "south": picture[262:284, :330]}
    dark = {name: int(near(strip, LIGHT.ink).sum()) for name, strip in strips.items()}
    assert dark[side] > 20 and max(dark, key=dark.get) == side


def test_the_same_history_makes_the_same_picture():
    env = played(30, scene="random")
    first = env.render()
    assert_array_equal(env.render(), first)
    twins = copy.deepcopy(env), pickle.loads(pickle.dumps(env))
    env.step(0)
    for twin in twins:
        assert_array_equal(twin.render(), first)
        twin.step(0)
        assert_array_equal(twin.render(), env.render())


def test_a_picture_does_not_depend_on_later_epochs():
    short = played(20, seed=3, episode_steps=21)
    long = played(20, seed=3, episode_steps=60)
    assert_array_equal(short.render(), long.render())


def test_an_estimate_that_is_not_finite_can_be_drawn():
    lost = history(truth=HERE * 3, estimate=HERE * 3, modes=[0] * 3)
    for broken in (np.nan, np.inf, 1e300):
        lost.estimate[-1] = broken
        lost.P[-1] = broken
        lost.nees[-1] = broken
        draw_picture(lost, ["ekf"])


@pytest.mark.parametrize("name", ["$x^2$\n two", "a\x00b\x1b[31m", "Привет λ", "中", "\ud800", ""])
def test_any_name_and_any_title_can_be_drawn(name):
    picture = draw_picture(history(name=name * 50), [name, "x" * 500], title=name * 50)
    assert picture.shape == (480, 480, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [("render_mode", "ansi"), ("render_size", 479), ("render_size", 481), ("render_theme", "blue")],
)
def test_wrong_render_options_are_refused(name, value):
    with refuses(name):
        MmWaveLocEnv(**{"render_mode": "rgb_array"} | {name: value})


@every_theme
def test_text_has_enough_contrast_with_its_background(theme):
    """Compute the contrast as WCAG 2.2 defines it."""

    def light(color):
        shares = np.array(color) / 255.0
        linear = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
        return linear @ [0.2126, 0.7152, 0.0722] + 0.05

    colors = THEMES[theme]
    for ground in (colors.paper, colors.ground):
        for words in (colors.ink, colors.quiet):
            assert max(light(words) / light(ground), light(ground) / light(words)) > 4.5


FRAME = Rect(0.0, 20.0, 480.0, 260.0)


def views(seed, action, **arguments):
    """Yield, for each epoch, the history so far, the view, and the pixels of user and estimate."""
    env = played(0, seed, **arguments).unwrapped
    over = False
    while not over:
        *_, over, _ = env.step(action)
    history = env._gallery.history(0)
    for epochs in range(history.epochs + 1):
        so_far = history.part(slice(epochs + 1))
        view = follow(so_far, FRAME)
        now = np.stack([so_far.truth[-1, :2], so_far.estimate[-1, :2]])
        yield so_far, view, view.pixels(now)


@pytest.mark.parametrize(("seed", "scenario"), [(0, "mixed"), (3, "mixed"), (0, "vehicle")])
def test_user_and_estimate_are_always_in_the_frame(seed, scenario):
    """Check three episodes, one with a vehicle whose estimate has an error of more than 15 m."""
    worst = 0.0
    for so_far, _, pixels in views(seed, 0, scenario=scenario):
        worst = max(worst, so_far.error_m[-1])
        assert (pixels > (10.0, 30.0)).all() and (pixels < (470.0, 270.0)).all()
    assert worst > 15.0 or scenario == "mixed"


def test_the_view_moves_smoothly():
    shown = [(view.center_m, view.scale) for _, view, _ in views(3, 1)]
    for (before, scale), (after, later) in pairwise(shown[5:]):
        assert np.hypot(*(after - before)) * scale < 40.0
        assert 0.8 < later / scale < 1.25


@pytest.mark.parametrize("end", [pygame.quit, pygame.font.quit])
def test_pictures_survive_the_end_of_pygame(end):
    """Check what Gymnasium's own environments do when they close."""
    env = played(0)
    before = env.render()
    end()
    assert_array_equal(env.render(), before)
