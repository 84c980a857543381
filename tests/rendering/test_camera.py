"""The camera: who is in the frame, and that it does not jump."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest

from mmwave_env.rendering.camera import clipped, follow, nice
from mmwave_env.rendering.canvas import Rect

ID = "mmwave_env:MmWaveLoc-v0"
FRAME = Rect(0.0, 20.0, 480.0, 260.0)


def views(seed, action, **arguments):
    """The view after every epoch of an episode, and where user and estimate are in it, px."""
    env = gym.make(ID, render_mode="rgb_array", **arguments).unwrapped
    env.reset(seed=seed)
    over = False
    while not over:
        *_, over, _ = env.step(action)
    history = env._recorder.history
    for epochs in range(history.epochs + 1):
        so_far = history.until(epochs)
        view = follow(so_far, FRAME)
        now = np.stack([so_far.truth[-1, :2], so_far.estimate[-1, :2]])
        yield so_far, view, view.pixels(now)


@pytest.mark.parametrize("seed", range(5))
def test_user_and_estimate_are_always_in_the_frame(seed):
    for _, _, pixels in views(seed, 0):
        assert (pixels > (10.0, 30.0)).all() and (pixels < (470.0, 270.0)).all()


def test_a_lost_track_is_not_lost_by_the_camera():
    worst = 0.0
    for so_far, _, pixels in views(0, 0, scenario="vehicle"):
        worst = max(worst, so_far.error_m[-1])
        assert (pixels > (10.0, 30.0)).all() and (pixels < (470.0, 270.0)).all()
    assert worst > 15.0


def test_the_picture_moves_smoothly():
    seen = [(view.center_m, view.scale) for _, view, _ in views(3, 1)]
    for (before, scale), (after, later) in pairwise(seen[5:]):
        assert np.hypot(*(after - before)) * scale < 40.0
        assert 0.8 < later / scale < 1.25


@pytest.mark.parametrize(
    ("start", "end", "inside"),
    [
        ((1, 1), (2, 2), ((1, 1), (2, 2))),
        ((5, 5), (25, 5), ((5, 5), (10, 5))),
        ((-5, 5), (15, 5), ((0, 5), (10, 5))),
        ((-5, -5), (-1, 20), None),
        ((5, 5), (5, 5), ((5, 5), (5, 5))),
        ((11, 5), (11, 5), None),
    ],
)
def test_lines_are_cut_at_the_frame(start, end, inside):
    assert clipped(start, end, Rect(0, 0, 10, 10)) == inside


@pytest.mark.parametrize(("value", "round_one"), [(1.0, 1), (4.9, 2), (99, 50), (0.3, 0.2)])
def test_round_lengths(value, round_one):
    assert nice(value) == pytest.approx(round_one)
