"""Tests of pictures of vector environments, and of Gymnasium's video wrapper."""

import gymnasium as gym
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmwave_env.env import MmWaveLocEnv
from mmwave_env.rendering.gallery import DRAWN

ID = "mmwave_env:MmWaveLoc-v0"
STEPS = 6
ONES = np.ones(3, np.int64)  # actions


def many(n=3, mode="NextStep", **arguments):
    arguments = {"render_mode": "rgb_array", "episode_steps": STEPS, **arguments}
    return gym.make_vec(
        ID, num_envs=n, vectorization_mode="vector_entry_point", autoreset_mode=mode, **arguments
    )


def single(seed, steps, resets=0, **arguments):
    """Return an environment's picture after ``resets`` extra resets and ``steps`` steps."""
    env = gym.make(ID, render_mode="rgb_array", episode_steps=STEPS, **arguments).unwrapped
    env.reset(seed=seed)
    for _ in range(resets):
        env.reset()
    for _ in range(steps):
        env.step(1)
    return env.render()


@pytest.mark.parametrize("arguments", [{}, {"scene": "random"}, {"episodes": "canyon28_vehicle"}])
def test_pictures_equal_the_pictures_of_single_environments(arguments):
    envs = many(**arguments)
    envs.reset(seed=5)
    for steps in range(3):
        pictures = envs.render()
        assert isinstance(pictures, tuple) and len(pictures) == 3
        for i, picture in enumerate(pictures):
            assert_array_equal(picture, single(5 + i, steps, **arguments))
        envs.step(ONES)


def test_the_next_episode_is_drawn_after_an_autoreset():
    for mode, steps in (("NextStep", STEPS + 1), ("SameStep", STEPS)):
        envs = many(mode=mode)
        envs.reset(seed=5)
        for _ in range(steps):
            envs.step(ONES)
        for i, picture in enumerate(envs.render()):
            assert_array_equal(picture, single(5 + i, 0, 1))


def test_a_reset_of_one_environment_does_not_change_the_pictures_of_others():
    envs = many(mode="Disabled")
    envs.reset(seed=5)
    envs.step(ONES)
    before = envs.render()
    envs.reset(options={"reset_mask": np.array([False, True, False])})
    after = envs.render()
    assert_array_equal(after[0], before[0])
    assert_array_equal(after[1], single(6, 0, 1))


def test_of_many_environments_only_the_first_few_are_drawn():
    envs = many(DRAWN + 3)
    envs.reset(seed=0)
    pictures = envs.render()
    assert len(pictures) == DRAWN + 3
    assert len({picture.tobytes() for picture in pictures}) == DRAWN + 1


@pytest.mark.parametrize("make", [MmWaveLocEnv, many])
def test_there_is_no_picture_before_a_reset_or_without_a_render_mode(make):
    with pytest.raises(gym.error.ResetNeeded):
        make(render_mode="rgb_array").render()
    assert make(render_mode=None).render() is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # warnings of moviepy
def test_a_video_of_an_episode_has_all_its_pictures(tmp_path):
    moviepy = pytest.importorskip("moviepy")
    env = gym.make(ID, render_mode="rgb_array", episode_steps=STEPS)
    env = gym.wrappers.RecordVideo(env, str(tmp_path), episode_trigger=lambda _: True)
    env.reset(seed=0)
    for _ in range(STEPS):
        env.step(1)
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    with moviepy.VideoFileClip(str(video)) as clip:
        assert tuple(clip.size) == (480, 480) and len([*clip.iter_frames()]) == STEPS + 1
