"""Tests, on tuning seeds, that the shipped corrector does no harm outside its training."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from experiments.evaluation.contenders import Contender
from experiments.evaluation.intervals import bootstrap
from experiments.evaluation.runner import run_contender
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.task import task_from
from mmwave_env.world.simulated import SimulatedSource

pytestmark = pytest.mark.slow

N, EPOCHS, SEED = 100, 200, 5_400_000
MOST_HARM = 0.02  # reward per epoch
FACTORS = (1.0, 4.0, 8.0, 16.0)  # of the stated noise
BLOCK_M = 80.0  # between the streets of the default scene


def noise(episode, factor):
    """Return an episode whose receiver states its noise times a wrong factor."""
    return replace(episode, sigma=factor * episode.sigma)


def turned(episode, angle=0.2):
    """Return an episode whose receiver is turned by an angle that it does not know."""
    z = episode.measurement.copy()
    z[:, 1:12:4] += angle
    return replace(episode, measurement=z)


def alone(episode):
    """Return an episode in which only the base station is measured."""
    visible = episode.visible.copy()
    visible[:, 1:3] = False
    return replace(episode, visible=visible)


def false_paths(episode):
    """Return an episode in which 5 % of the links are false paths."""
    rng, z = np.random.default_rng(0), episode.measurement.copy()
    for link in range(3):
        false = rng.random((len(z), 1)) < 0.05
        size = np.array([30.0, 0.5, 0.1, 0.5])
        z[:, 4 * link : 4 * link + 4] += false * rng.normal(0.0, size, (len(z), 4))
    return replace(episode, measurement=z)


def corners(path):
    """Write the way of a car that turns at every crossing, at 10 m/s; return its file."""
    every_s = BLOCK_M / 10.0
    crossings = [(0, 0), (1, 0), (1, 1), (2, 1), (2, 2), (1, 2), (1, 1), (0, 1)]
    t = np.arange(4 * EPOCHS)
    nodes = BLOCK_M * np.array([crossings[i % 8] for i in range(t[-1] // int(every_s) + 2)])
    x, y = (np.interp(t, every_s * np.arange(len(nodes)), nodes[:, i]) for i in range(2))
    return written(path, t, x, y - 2.0 * BLOCK_M)


def bus(path):
    """Write the way of a bus to and fro that stops every 300 m for 15 s; return its file."""
    t = np.arange(4 * EPOCHS)
    ramp, cruise = 10.0, 15.0  # seconds to reach 12 m/s, and seconds at that speed
    leg = np.interp(np.arange(50), [0, ramp, ramp + cruise, 2 * ramp + cruise], [0, 12, 12, 0])
    gone = np.cumsum(np.resize(leg, len(t)))
    fro = gone % (4.0 * BLOCK_M)
    return written(path, t, np.minimum(fro, 4.0 * BLOCK_M - fro), 0.0 * t)


def written(path, t, x, y):
    rows = [f"{a},{b:.3f},{c:.3f},1.5" for a, b, c in zip(t, x, y, strict=True)]
    path.write_text("\n".join(["t,x,y,z", *rows]))
    return str(path)


def simulated(radio="handset", **arguments):
    return task_from(radio=radio, **arguments).simulated


FAR = SimulatedSource(RandomScene(block_m=(800.0, 1000.0)), RADIOS["handset"])
LINKS = ("range", "azimuth", "elevation", "departure")
CASES = {  # name -> source of episodes or function of a folder, radio, what is wrong
    "the default street": (simulated(), "handset", None),
    "an unknown clock offset": (simulated(clock="offset"), "handset", None),
    "range and azimuth": (simulated(measurements=("range", "azimuth")), "handset", None),
    "angles alone": (simulated(measurements=(*LINKS[1:], "doppler")), "handset", None),
    "no Doppler shift": (simulated("standard", measurements=LINKS), "standard", None),
    "another radio's name": (simulated(), "high", None),
    "noise twice what is stated": (simulated(), "handset", lambda e: noise(e, 0.5)),
    "noise half of what is stated": (simulated(), "handset", lambda e: noise(e, 2.0)),
    "a step of 2 s": (simulated(dt=2.0), "handset", None),
    "corners at 10 m/s": (lambda to: simulated(scenario=corners(to / "way.csv")), "handset", None),
    "a bus with stops": (lambda to: simulated(scenario=bus(to / "bus.csv")), "standard", None),
    "false paths": (simulated(), "handset", false_paths),
    "one anchor alone": (simulated(), "handset", alone),
    "angles in a wrong frame": (simulated(), "handset", turned),
    "a street ten times as wide": (FAR, "handset", None),
}


def played(name, radio, episodes):
    """Return reward per epoch (n,), and how far corrections are trusted (n, T)."""
    contender = Contender.learned(name, name, radio)
    results = run_contender(contender, contender.start(episodes[0].layout), episodes)
    return results["reward"][:, 10:].mean(axis=1), results.get("trusted")


def against_base(radio, episodes):
    """Return reward minus that of the base (n,), and how far corrections are trusted (n, T)."""
    ours, trusted = played("corrector", radio, episodes)
    return ours - played("guided", radio, episodes)[0], trusted


def gain(case, folder, n=N):
    """Play n episodes of a case, and return what :func:`against_base` does."""
    source, radio, wrong = CASES[case]
    source = source if isinstance(source, SimulatedSource) else source(folder)
    episodes = source.episodes(np.arange(SEED, SEED + n, dtype=np.uint64))
    return against_base(radio, [wrong(e) for e in episodes] if wrong else episodes)


def print_table(n=300):
    """Print the tables of docs/learning.md."""
    print("| case | radio | minus guided | trusted |\n|---|---|---|---|")
    for case, (_, radio, _) in CASES.items():
        with TemporaryDirectory() as folder:
            gains, trusted = gain(case, Path(folder), n)
        (mean,), share = bootstrap(gains[:, None]), trusted[:, 10:].mean()
        print(f"| {case} | {radio} | {mean} | {share:.2f} |")
    print("\n| stated noise / noise | trusted |\n|---|---|")
    for too in (1.0, -1.0):
        for factor, (_, share) in zip(FACTORS, trust(too), strict=True):
            print(f"| {factor**too:g} | {share:.2f} |")


@pytest.mark.parametrize("case", CASES)
def test_it_is_hardly_below_its_base_where_it_was_never_trained(case, tmp_path):
    gains, trusted = gain(case, tmp_path)
    assert gains.mean() > -MOST_HARM
    assert ((trusted >= 0.0) & (trusted <= 1.0)).all()


def trust(too):
    """Return for every factor the gain over the base, and how far corrections are trusted."""
    episodes = simulated("standard").episodes(np.arange(SEED, SEED + 20, dtype=np.uint64))
    for factor in FACTORS:
        gains, trusted = against_base("standard", [noise(e, factor**too) for e in episodes])
        yield gains.mean(), trusted[:, 10:].mean()


@pytest.mark.parametrize("too", [1.0, -1.0])
def test_trust_falls_as_features_leave_the_range_of_training(too):
    gains, shares = zip(*trust(too), strict=True)
    assert min(gains) > -MOST_HARM
    assert shares[0] > 0.95 and shares[-1] < 0.3 and (np.diff(shares) < 0.0).all()
