"""Tests that simulated users move as people and cars can, and that mobility files are checked."""

from collections import Counter
from dataclasses import asdict, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import binom

from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.keys import keys_of
from mmwave_env.world.mobility import (
    MOBILITIES,
    Gait,
    Limits,
    Mobility,
    Phase,
    mobilities_of,
)
from mmwave_env.world.simulated import SimulatedSource
from tests.filters.tracks import sampled, street_source
from tests.paths import representative, write_json
from tests.refusals import refuses

STEP_S = 0.1
STEPS = 2000
SEEDS = 40


class Bounds(NamedTuple):
    """Bounds on the motion of a kind of user, according to the project's model of mobility."""

    speed: float  # maximum, m/s
    acceleration: float  # maximum, m/s^2
    braking: float  # maximum, m/s^2
    jerk: float  # maximum, m/s^3
    radius: float  # radius of the arcs at crossings, m


DRIVING = Bounds(20.0, 3.0, 3.5, 4.0, 8.0)
BOUNDS = {
    "pedestrian": Bounds(1.9, 1.0, 1.5, 2.0, 1.0),
    "vehicle": DRIVING,
    "walk-ride": DRIVING,
    "jam": DRIVING._replace(speed=7.0),
    "cyclist": Bounds(6.5, 1.2, 2.5, 2.0, 4.0),
}
MIXED = ("pedestrian", "vehicle", "walk-ride", "jam", "cyclist")  # an episode key selects one
LATERAL_MPS2 = 5.0  # drivers aim at no more than 3.5 m/s^2, but take corners a little faster

every_mobility = pytest.mark.parametrize("name", BOUNDS)
every_scene = pytest.mark.parametrize("scene", representative(SCENES, "street"))


class Users(NamedTuple):
    """Horizontal tracks of many users of one kind."""

    position: np.ndarray  # (SEEDS, STEPS, 2)
    velocity: np.ndarray  # (SEEDS, STEPS, 2)
    speed: np.ndarray  # (SEEDS, STEPS)


def run(name, seeds, dt, epochs, scene="street"):
    """Return positions and velocities (seeds, epochs, 3) of one user per seed."""
    source = SimulatedSource(SCENES[scene], RADIOS["handset"], name, dt, epochs)
    truth = source.sample_batch(keys_of(seeds)).table[..., -6:]
    return truth[..., :3], truth[..., 3:]


@cache
def tracks(name, scene="street"):
    position, velocity = run(name, range(SEEDS), STEP_S, STEPS, scene)
    return Users(position[..., :2], velocity[..., :2], np.linalg.norm(velocity, axis=-1))


@every_mobility
def test_acceleration_and_braking_are_bounded(name):
    """Check also that jerk and speed are bounded, and that the highest speed is near its bound."""
    speed = tracks(name).speed
    bounds = BOUNDS[name]
    assert 0.8 * bounds.speed < speed.max() <= bounds.speed + 1e-9
    change = np.diff(speed) / STEP_S
    assert change.max() <= bounds.acceleration + 1e-9
    assert -change.min() <= bounds.braking + 1e-9
    assert np.abs(np.diff(change)).max() / STEP_S <= bounds.jerk + 1e-6


@every_scene
@every_mobility
def test_lateral_acceleration_in_turns_is_bounded(name, scene):
    velocity = tracks(name, scene).velocity
    middle = 0.5 * (velocity[:, 1:] + velocity[:, :-1])
    change = np.diff(velocity, axis=1) / STEP_S
    across = middle[..., 0] * change[..., 1] - middle[..., 1] * change[..., 0]
    speed = np.linalg.norm(middle, axis=-1)
    lateral = np.abs(across) / np.maximum(speed, 0.3)
    assert lateral.max() <= LATERAL_MPS2


@every_scene
@every_mobility
def test_position_is_the_integral_of_velocity(name, scene):
    position, velocity, _ = tracks(name, scene)
    trapezoid = 0.5 * STEP_S * (velocity[:, 1:] + velocity[:, :-1])
    slip = np.linalg.norm(np.diff(position, axis=1) - trapezoid, axis=-1)
    # The mean velocity of a step lies between the velocities at its ends.
    between = 0.5 * STEP_S * np.linalg.norm(np.diff(velocity, axis=1), axis=-1)
    assert (slip <= between + 1e-3).all()


@every_scene
@every_mobility
def test_users_stay_in_the_streets(name, scene):
    position = tracks(name, scene).position
    streets = SCENES[scene].streets
    block = streets.block_m / MOBILITIES[name].blocks
    low = np.array([streets.x_m[0], streets.y_m[0]])
    high = np.array([streets.x_m[1], streets.y_m[1]])
    # Users leave the center line of a street where they cut a corner on an arc of radius R. At a
    # dead end, they turn on a half circle, and then return at a distance of 2 R from the line.
    radius = BOUNDS[name].radius
    dead_ends = low[0] == high[0] or low[1] == high[1]
    aside = 2.0 * radius if dead_ends else (1.0 - np.sqrt(0.5)) * radius
    offset = np.abs((position - low + 0.5 * block) % block - 0.5 * block)
    assert offset.min(axis=-1).max() <= aside + 0.1
    beyond = np.maximum(low - position, position - high)
    across = np.where(low == high, aside, 0.0)
    assert (beyond <= across + 0.1).all()


@pytest.mark.parametrize("name", ["pedestrian", "vehicle", "jam"])
def test_most_users_stop_for_a_while(name):
    standing = tracks(name).speed < 0.01
    whiles = sliding_window_view(standing, round(2.0 / STEP_S), axis=1)
    assert whiles.all(axis=-1).any(axis=1).mean() > 0.5
    assert (standing.mean(axis=1) < 0.95).all()  # all users move again


def test_users_of_walk_ride_first_walk_then_ride_then_walk():
    speed = tracks("walk-ride").speed
    on_foot = BOUNDS["pedestrian"].speed
    # Each walk lasts at least 45 s, but braking to a walk may take the first 10 s of the last walk.
    first = round(45.0 / STEP_S)
    last = round(35.0 / STEP_S)
    assert speed[:, :first].max() <= on_foot + 1e-9
    assert speed[:, -last:].max() <= 2.0
    assert (speed[:, first:-last].max(axis=1) > 7.0).all()
    assert (speed[:, :first].max(axis=1) > 0.4).mean() > 0.9


@every_mobility
@pytest.mark.parametrize("dt", [0.5, 1.0, 2.0])
def test_the_time_step_does_not_change_the_trajectory(name, dt):
    fine = np.array(run(name, [0], STEP_S, STEPS))
    coarse = np.array(run(name, [0], dt, round(STEPS * STEP_S / dt)))
    np.testing.assert_allclose(coarse, fine[:, :, :: round(dt / STEP_S)], atol=1e-8)


def test_the_scenario_mixed_draws_every_kind_of_user_with_the_same_probability():
    assert set(MOBILITIES) == set(BOUNDS)
    assert tuple(m.name for m in mobilities_of("mixed")) == MIXED
    draws = 2000
    source = street_source(epochs=1)
    counts = Counter(source.sample_batch(keys_of(range(draws))).names)
    assert set(counts) == set(MIXED)
    # With a probability of 99 %, all five counts are in the interval (Bonferroni).
    low, high = binom.interval(1.0 - 0.01 / 5, draws, 1.0 / 5)
    assert all(low <= count <= high for count in counts.values())


LIMITS = Limits((0.5, 1.5), (1.0, 2.0), (1.0, 2.0), 2.0, 3.0)
GAIT = {"low_mps": 3, "high_mps": 7}
SCOOTER = {"phases": [{"limits": asdict(LIMITS), "gaits": [GAIT]}], "blocks": 2}


@pytest.fixture
def path(tmp_path):
    return write_json(tmp_path / "scooter.json", SCOOTER)


def with_phase(**changes):
    """Return the content of a mobility file whose only phase is changed."""
    (phase,) = SCOOTER["phases"]
    return SCOOTER | {"phases": [phase | changes]}


def test_a_mobility_file_defines_a_kind_of_user(path):
    (scooter,) = mobilities_of(path)
    assert scooter == Mobility("scooter", (Phase(LIMITS, (Gait(3.0, 7.0),)),), blocks=2)


@pytest.mark.parametrize(
    ("content", "field"),
    [
        (with_phase(gaits=[{"low_mps": 3, "high_mps": 2}]), "phases[0].gaits[0].high_mps"),
        (with_phase(duration_s=[10, 20]), "phases[0].duration_s"),
        (SCOOTER | {"ends_as_it_began": True}, "phases[0].duration_s"),
        (SCOOTER | {"phases": SCOOTER["phases"] * 2}, "phases[0].duration_s"),
    ],
)
def test_a_damaged_mobility_file_is_refused_with_the_name_of_the_field(path, content, field):
    write_json(path, content)
    with refuses(path, field):
        mobilities_of(path)


def test_corners_that_do_not_fit_between_crossings_are_refused(path):
    write_json(path, SCOOTER | {"blocks": 16})
    with refuses("corner_radius_m of mobility 'scooter'"):
        street_source(path)


def ranges(low, high):
    return st.lists(st.floats(low, high), min_size=2, max_size=2).map(sorted).map(tuple)


ANY_GAITS = st.lists(st.floats(0.0, 40.0).map(lambda v: Gait(v / 2.0, v, 10.0)), min_size=1)
RATES = [ranges(0.3, 10.0)] * 3 + [st.floats(0.5, 30.0)]
ANY_LIMITS = st.builds(Limits, *RATES, st.floats(0.1, 10.0), st.floats(0.0, 1.0), ranges(0.0, 5.0))


@settings(max_examples=20)
@given(
    limits=ANY_LIMITS,
    gaits=ANY_GAITS.filter(lambda gaits: len(gaits) < 4),
    blocks=st.integers(1, 4),
    twice=st.booleans(),
)
def test_users_of_any_kind_stay_on_the_streets(limits, gaits, blocks, twice):
    phase = Phase(limits, tuple(gaits))
    phases = (replace(phase, duration_s=(5.0, 20.0)), phase) if twice else (phase,)
    source = street_source(Mobility("any", phases, blocks), epochs=60)
    x, y, _ = sampled(source).truth_position_m.T
    assert -5.0 < x.min() and x.max() < 165.0 and -165.0 < y.min() and y.max() < 5.0
