"""The clearest moment is a stop and a pull-away at which one contender falls behind."""

import numpy as np
import pytest

from experiments.evaluation.contenders import contender_from
from experiments.evaluation.events import fast_pull_aways, fast_stops, speeds, velocities
from experiments.evaluation.moments import AFTER_S, BEFORE_S, Moment, PullAways
from experiments.evaluation.seeds import draw_episodes
from mmwave_env.task import task_from

COUNT = 12
LOSER, KEEPER = (contender_from(name, "handset") for name in ("speed-rule", "fixed-ukf"))
BEFORE, AFTER = int(BEFORE_S), int(AFTER_S)  # epochs of a second


@pytest.fixture(scope="module")
def episodes():
    return draw_episodes(task_from(scenario="vehicle").source, range(COUNT))


@pytest.fixture(scope="module")
def pull_aways(episodes):
    """Episodes and epochs of those with a stop before them."""
    speed = speeds(velocities(episodes))
    stops = fast_stops(speed, 1.0)
    return [
        (i, t)
        for i, t in np.argwhere(fast_pull_aways(speed, 1.0)).tolist()
        if BEFORE <= t < speed.shape[1] - AFTER and stops[i, t - BEFORE : t].any()
    ]


def found(episodes, lost_m, kept_m):
    """The clearest moment where position errors (n, T) are these; they come in two parts."""
    pulls = PullAways(LOSER.name, KEEPER.name)
    for part in (slice(0, 5), slice(5, None)):
        for contender, errors in ((LOSER, lost_m), (KEEPER, kept_m)):
            along_x = np.stack([errors, 0.0 * errors, 0.0 * errors], axis=-1)
            pulls.add(contender, episodes[part], {"error": along_x[part]})
    return pulls.clearest


@pytest.mark.parametrize("which", [0, 1, -1])
def test_it_is_where_the_loser_falls_behind_most(which, episodes, pull_aways):
    i, t = pull_aways[which]
    near = np.ones((COUNT, len(episodes[0])))
    lost = near.copy()
    for other, later in pull_aways:
        if other != i:
            lost[other, later : later + AFTER + 1] = 20.0
    lost[i, t : t + AFTER + 1] = 30.0
    assert found(episodes, lost, near) == Moment(i, (t - BEFORE, t + AFTER))


def test_there_is_none_where_both_lose_the_track_or_it_was_lost_before(episodes):
    near = np.ones((COUNT, len(episodes[0])))
    for lost, kept in ((9.0 * near, near), (near, 9.0 * near)):
        with pytest.raises(ValueError, match="clearest: found none of 12 episodes.*fixed-ukf"):
            found(episodes, lost, kept)
