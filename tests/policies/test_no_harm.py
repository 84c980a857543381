"""Tests that the shipped corrector does no harm in tasks that it was not trained for.

A corrector corrects another policy's beliefs. The episodes' keys (64-bit seeds) are in the range
of tuning seeds.
"""

from dataclasses import replace

import numpy as np
import pytest

from experiments.evaluation.contenders import Contender
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.protocol import HARD_SOURCES, Misstated
from experiments.evaluation.runner import run_contender
from experiments.training.corrector_data import begin_from_a_link
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SCENES
from mmwave_env.task import task_from
from mmwave_env.world.episode import EpisodeBatch
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import lasting

pytestmark = pytest.mark.slow

N = 100
SEED = 5_400_000
MOST_HARM = 0.02  # mean reward per epoch that the corrector may lose against its base policy
# Factors by which the stated noise (the standard deviations in an episode) is too high or too low
FACTORS = (1.0, 4.0, 8.0, 16.0)


def turned(episode):
    """Return an episode whose receiver is turned by 0.2 rad."""
    z = episode.measurement.copy()
    z[:, 1:12:4] += 0.2
    return replace(episode, measurement=z)


def alone(episode):
    """Return an episode in which only the base station is measured."""
    visible = episode.visible.copy()
    visible[:, 1:3] = False
    return replace(episode, visible=visible)


def rng_of(episode):
    return np.random.default_rng(abs(episode.measurement[0, 0].view(np.int64)))


def shifted(range_m=0.0, azimuth_deg=0.0, elevation_deg=0.0):
    """Return a function that shifts the measurements of all links alike, as a bad survey does."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])

    def shift(episode):
        z = episode.measurement.copy()
        z[:, :12] += np.tile([range_m, azimuth, elevation, azimuth], 3)
        return replace(episode, measurement=z)

    return shift


def misplaced(up_m=0.0, apart_m=0.0):
    """Return a function that misplaces all anchors upwards, and each one horizontally."""

    def misplace(episode):
        anchors = episode.scene_anchors_m + np.array([0.0, 0.0, up_m])
        rng = rng_of(episode)
        anchors[:, :2] += rng.normal(0.0, apart_m, (3, 2))
        return replace(episode, scene_anchors_m=anchors)

    return misplace


def slow_noise(episode):
    """Return an episode with additional errors that change slowly, twice the stated noise."""
    rng = rng_of(episode)
    z = episode.measurement.copy()
    z[:, :12] += 2.0 * lasting(rng, len(z), 12, keep=0.99) * episode.sigma[:, :12]
    return replace(episode, measurement=z)


def false_paths(episode):
    """Return an episode in which 5 % of the links are false paths."""
    rng = np.random.default_rng(0)
    z = episode.measurement.copy()
    for link in range(3):
        false = rng.random((len(z), 1)) < 0.05
        size = np.array([30.0, 0.5, 0.1, 0.5])
        z[:, 4 * link : 4 * link + 4] += false * rng.normal(0.0, size, (len(z), 4))
    return replace(episode, measurement=z)


def simulated(radio="handset", **arguments):
    return task_from(radio=radio, **arguments).simulated


FAR = SimulatedSource(RandomScene(block_m=(800.0, 1000.0)), RADIOS["handset"])
HALF = Misstated(SCENES["street"], RADIOS["handset"], stated=2.0)
LINKS = ("range", "azimuth", "elevation", "departure")
HARD = {name: make() for name, make in HARD_SOURCES.items()}
CASES = {  # name -> source of episodes, radio, function that falsifies an episode
    "the default street": (simulated(), "handset", None),
    "an unknown clock offset": (HARD["clock-offset:handset"], "handset", None),
    "range and azimuth": (HARD["range-azimuth:handset"], "handset", None),
    "angles alone": (simulated(measurements=(*LINKS[1:], "doppler")), "handset", None),
    "no Doppler shift": (simulated("standard", measurements=LINKS), "standard", None),
    "another radio's name": (simulated(), "high", None),
    "noise twice what is stated": (HARD["noise-twice:handset"], "handset", None),
    "noise half of what is stated": (HALF, "handset", None),
    "a step of 2 s": (simulated(dt=2.0), "handset", None),
    "corners at 10 m/s": (HARD["corners:handset"], "handset", None),
    "a bus with stops": (HARD["bus:standard"], "standard", None),
    "false paths": (simulated(), "handset", false_paths),
    "one anchor alone": (simulated(), "handset", alone),
    "angles in a wrong frame": (simulated(), "handset", turned),
    "a street ten times as wide": (FAR, "handset", None),
}


# errors that all links share, so that no gate sees them
SHARED = {
    "no error": shifted(),
    "azimuths 3 degrees off": shifted(azimuth_deg=3.0),
    "azimuths 5 degrees off": shifted(azimuth_deg=5.0),
    "elevations 3 degrees off": shifted(elevation_deg=3.0),
    "ranges 1 m long": shifted(range_m=1.0),
    "anchors 5 m too high": misplaced(up_m=5.0),
    "each anchor 1 m off": misplaced(apart_m=1.0),
    "slow noise": slow_noise,
}
STARTS = ("as simulated", "from a link")
# reward that the corrector may lose where it does not see an error: the published training loses
# about 0.045 in both kinds of tracks
LOSSES = {("azimuths 3 degrees off", "handset"): 0.1}
every_radio = pytest.mark.parametrize("radio", ["handset", "standard"])


def played(name, radio, episodes):
    """Return each episode's mean reward (n,) from its 11th epoch on, and the policy's trust.

    Trust (n, T), from 0 to 1, is the factor that the policy applies to its correction.
    """
    contender = Contender.learned(name, name, radio)
    results = run_contender(contender, episodes)
    return results["reward"][:, 10:].mean(axis=1), results.get("trusted")


def against_base(radio, episodes, policy="corrector"):
    """Return a corrector's gain in mean reward over its base policy (n,), and trusts (n, T)."""
    ours, trusted = played(policy, radio, episodes)
    return ours - played("guided", radio, episodes)[0], trusted


def gain(case, n=N):
    """Play n episodes of a case, and return the results of :func:`against_base`."""
    source, radio, wrong = CASES[case]
    episodes = source.episodes(keys(n))
    return against_base(radio, [wrong(e) for e in episodes] if wrong else episodes)


def keys(n):
    """Return the keys of n episodes."""
    return np.arange(SEED, SEED + n, dtype=np.uint64)


def gains_from(start, source, episodes, radio, policy="corrector"):
    """Return a corrector's gains in mean reward (n,) in tracks that begin as in ``STARTS``."""
    batch = EpisodeBatch.of(episodes)
    if start == "from a link":
        begin_from_a_link(batch, source)
    return against_base(radio, batch, policy)[0]


def shared_gain(policy, error, radio, start, n=N):
    """Play n episodes of a shared error; return a corrector's gains in mean reward (n,)."""
    source = simulated(radio)
    episodes = [SHARED[error](episode) for episode in source.episodes(keys(n))]
    return gains_from(start, source, episodes, radio, policy)


def print_shared(policy="corrector"):
    """Print how a corrector fares where all links are wrong together (docs/learning.md)."""
    print(f"| error | radio | {' | '.join(STARTS)} |\n|---|---|---|---|")
    for error in SHARED:
        for radio in ("handset", "standard"):
            gains = [shared_gain(policy, error, radio, start, 300) for start in STARTS]
            means = " | ".join(map(str, bootstrap(gains)))
            print(f"| {error} | {radio} | {means} |")


def print_table():
    """Print the tables of docs/learning.md."""
    print("| case | radio | minus guided | trusted |\n|---|---|---|---|")
    for case, (_, radio, _) in CASES.items():
        gains, trusted = gain(case, 300)
        (mean,) = bootstrap([gains])
        share = trusted[:, 10:].mean()
        print(f"| {case} | {radio} | {mean} | {share:.2f} |")
    print("\n| stated noise / noise | trusted |\n|---|---|")
    for exponent in (1.0, -1.0):
        for factor, (_, share) in zip(FACTORS, trust(exponent), strict=True):
            print(f"| {factor**exponent:g} | {share:.2f} |")


@pytest.mark.parametrize("case", CASES)
def test_the_corrector_earns_hardly_less_than_its_base_policy_in_any_case(case):
    gains, trusted = gain(case)
    assert gains.mean() > -MOST_HARM
    assert ((trusted >= 0.0) & (trusted <= 1.0)).all()


@pytest.mark.parametrize("start", STARTS)
@every_radio
@pytest.mark.parametrize("error", SHARED)
def test_the_corrector_earns_hardly_less_where_all_links_are_wrong_together(error, radio, start):
    most = LOSSES.get((error, radio), MOST_HARM)
    assert shared_gain("corrector", error, radio, start).mean() > -most


@every_radio
@pytest.mark.parametrize("street", ["home", "random"])
def test_of_tracks_that_begin_from_a_link_at_most_three_in_a_thousand_lose_much(street, radio):
    source = simulated(radio)
    if street == "random":
        source = SimulatedSource(RandomScene(), RADIOS[radio])
    gains = gains_from("from a link", source, source.episodes(keys(1000)), radio)
    assert np.mean(gains < -0.5) <= 0.003


def trust(exponent):
    """Yield gain and trust for each factor: stated noise = factor**exponent * true noise."""
    for factor in FACTORS:
        source = Misstated(SCENES["street"], RADIOS["standard"], stated=factor**exponent)
        gains, trusted = against_base("standard", source.episodes(keys(20)))
        yield gains.mean(), trusted[:, 10:].mean()


@pytest.mark.parametrize("exponent", [1.0, -1.0])
def test_trust_falls_as_features_leave_the_range_of_training(exponent):
    gains, shares = zip(*trust(exponent), strict=True)
    assert min(gains) > -MOST_HARM
    assert shares[0] > 0.95 and shares[-1] < 0.3 and (np.diff(shares) < 0.0).all()
