"""Tests of a policy's history (the data of its pictures) against an environment's history."""

import gymnasium as gym
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from experiments.evaluation.contenders import contender_from, draw_episodes
from experiments.evaluation.runner import Scoring, history_of
from mmwave_env.datasets.recorded import TrackSource
from mmwave_env.datasets.samples import read_track
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.rendering.history import NO_MODE
from mmwave_env.task import task_from
from mmwave_env.world.keys import keys_of

SEED = 5
TASK = task_from()
(EPISODE,) = draw_episodes(TASK.source, [SEED])
SCENE = TASK.scene_of(int(keys_of([SEED])[0]))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("speed-rule", {}),
        # The next two cases are slow, because each compiles its own kernels.
        pytest.param("fixed-ukf", {"planar": True}, marks=pytest.mark.slow),
        pytest.param("guided", {"beliefs": "per-mode"}, marks=pytest.mark.slow),
    ],
)
def test_a_history_equals_what_an_environment_records(name, arguments):
    pytest.importorskip("pygame")
    scoring = Scoring(TrackingReward(), arguments.get("planar", False))
    contender = contender_from(name, "handset")
    history = history_of(contender, EPISODE, scoring, SCENE)
    arguments |= {"modes": contender.filters, "render_mode": "rgb_array"}
    env = gym.make("MmWaveLoc-v0", **arguments).unwrapped
    env.reset(seed=SEED)
    for mode in history.modes[1:]:
        env.step(mode)
    recorded = env._gallery.recorders[0].history
    assert history.axes == recorded.axes and history.epochs == recorded.epochs == len(EPISODE)
    assert history.name == recorded.name
    assert history.scene == recorded.scene is not None
    assert_array_equal(history.anchors_m, recorded.anchors_m)
    for field in ("time_s", "modes", "truth", "estimate", "P", "nees", "accepted", "rejected"):
        assert_allclose(
            getattr(history, field), getattr(recorded, field), err_msg=field, rtol=1e-9, atol=1e-9
        )


def test_the_history_of_an_imm_shows_the_most_probable_modes():
    contender = contender_from("imm", "handset")
    history = history_of(contender, EPISODE)
    assert history.modes[0] == NO_MODE
    assert set(history.modes[1:]) == set(range(len(contender.actions)))
    assert (history.accepted[1:] | history.rejected[1:]).any()


def test_the_history_of_a_recording_begins_at_its_prior():
    (episode,) = draw_episodes(TrackSource(read_track("canyon28_pedestrian"), "handset"), [0])
    history = history_of(contender_from("fixed-ukf", "handset"), episode)
    assert_array_equal(history.estimate[0], episode.prior_mean)
    assert history.scene is None and history.time_s[0] == history.time_s[1] == 0.0
    assert history.time_s[-1] == episode.time_s[-1] - episode.time_s[0]
