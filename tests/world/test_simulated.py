"""Tests of simulated episodes against a plain NumPy simulation with the same random numbers.

A key, a seed of 64 bits, determines an episode. The plain simulation shows how: which numbers are
drawn before the first epoch and in every epoch, and in which order. Trajectory and reception have
separate random generators.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SCENES
from mmwave_env.world.episode import Episode, EpisodeBatch, columns_of
from mmwave_env.world.kinematics import Net, move, state_of
from mmwave_env.world.mobility import mobilities_of, plans_of
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.simulation import RECEIVER, USER
from mmwave_env.world.trajectory import Trajectory
from mmwave_env.world.travel import attend, draw_phases, set_off, stride_of
from tests.filters.tracks import (
    around_a_block,
    assert_same_fields,
    geometry,
    sampled,
    street_source,
    wrapped,
)
from tests.numerics.test_random import theirs
from tests.paths import representative

SOURCES = {
    "default": street_source(),
    "odometry at 10 Hz": SimulatedSource(
        SCENES["o1"], RADIOS["high"], "walk-ride", dt=0.1, odometry=True
    ),
    "jam": SimulatedSource(SCENES["dynamic-doppler"], RADIOS["standard"], "jam", 0.5, epochs=77),
    "windows of a trajectory": street_source(around_a_block(), dt=0.7, epochs=30, odometry=True),
    "random streets": SimulatedSource(RandomScene(), RADIOS["standard"], epochs=60),
}
KEYS = np.random.default_rng(0).integers(0, 2**64, 20, np.uint64)
# For two in a thousand keys (none of KEYS), the two simulations give different trajectories: they
# round sums differently. For example, a user may choose a new speed one substep later in one
# simulation than in the other.


class PlainDice:
    """Random numbers from NumPy's SFC64. Normal numbers come in pairs; ``spare`` has the second."""

    def __init__(self, key, stream):
        self.rng = np.random.Generator(theirs(key, stream))
        self.spare = []

    def uniform(self, low=0.0, high=1.0):
        return low + (high - low) * self.rng.random()

    def exponential(self):
        return -np.log1p(-self.rng.random())

    def normal(self):
        if not self.spare:
            length = np.sqrt(2.0 * self.exponential())
            angle = 2.0 * np.pi * self.rng.random()
            self.spare = [length * np.sin(angle), length * np.cos(angle)]
        return float(self.spare.pop())

    def many(self, draw, *shape):
        return np.array([draw() for _ in range(int(np.prod(shape)))]).reshape(shape)


def spells(uniform, onset, leave, first):
    """Run an on-off Markov chain per column; return whether each is on, and since which epoch.

    The chance to turn on is ``onset``, to turn off ``leave``, and to be on in epoch 0 ``first``.
    """
    on = np.zeros(uniform.shape, bool)
    since = np.zeros(uniform.shape, int)
    for t, draw in enumerate(uniform):
        before = on[t - 1] if t else np.zeros(uniform.shape[1], bool)
        on[t] = np.where(before, draw >= leave, draw < (onset[t] if t else first))
        since[t] = np.where(before, since[t - 1], t)
    return on, since


def drawn(dice, T, L, rows):
    """Draw all numbers of the reception, epoch by epoch; return a list of arrays (T, ...)."""
    normal = dice.normal
    uniform = dice.uniform
    exponential = dice.exponential
    spells = [(exponential, L)] * 2 + [(normal, L, 3)] * 2 + [(uniform, L)]
    kinds = [(normal, L), (uniform, L), (uniform, L), (uniform, 1), *spells]
    kinds += [(normal, 1), (normal, 1), (normal, rows), (normal, 1)]
    epochs = []
    for _ in range(T):
        epochs.append([dice.many(*kind) for kind in kinds])
        dice.spare.clear()  # no number of a pair is kept for the next epoch
    return [np.array(each) for each in zip(*epochs, strict=True)]


def channel(radio, scene, distance, speed, dt, draws):
    """Return SNR and detection (T, L), biases (T, L, 4) and Doppler spread (T,) for T epochs."""
    shadow, blocking, reflecting, losing, blockage, multipath, *angles = draws[:8]
    detection, scatter, floor = draws[8:]
    T, L = distance.shape
    link = np.arange(L)
    loss = 32.4 + 21 * np.log10(distance) + 20 * np.log10(scene.carrier_hz / 1e9)
    loss[:, 1:] += radio.reflection_loss_db
    rho = radio.shadowing_correlation**dt
    for t in range(1, T):
        shadow[t] = rho * shadow[t - 1] + np.sqrt(1 - rho**2) * shadow[t]
    share = radio.blockage_scale * np.minimum(
        radio.blockage_limit, radio.blockage_base + radio.blockage_per_100m * distance / 100
    )
    leave = 1 - np.exp(-dt / radio.blockage_mean_s)
    blocked, begun = spells(blocking, leave * share / (1 - share), leave, share[0])
    rate = 1 - np.exp(-dt * radio.multipath_rate_hz)
    end = 1 - np.exp(-dt * (1 / radio.multipath_mean_s))
    reflected, arrived = spells(reflecting, np.full((T, L), rate), end, np.zeros(L))
    rate = 1 - np.exp(-dt * radio.outage_rate_hz)
    end = 1 - np.exp(-dt * (1 / radio.outage_mean_s))
    lost, _ = spells(losing, np.full((T, 1), rate), end, np.zeros(1))
    constant, mean = radio.multipath_range_m
    bias = np.zeros((T, L, 4))
    bias[..., 0] = blocked * radio.blockage_range_m * blockage[begun, link]
    bias[..., 0] += reflected * (constant + mean * multipath[arrived, link])
    bias[..., 1:] = blocked[..., None] * radio.blockage_angle_rad * angles[0][begun, link]
    bias[..., 1:] += reflected[..., None] * radio.multipath_angle_rad * angles[1][arrived, link]
    gain = -loss + radio.shadowing_db * shadow - radio.blockage_loss_db * blocked
    snr = radio.snr_db(gain, scene.bandwidth_hz)
    chance = 1 / (1 + np.exp(-(snr - radio.detection_snr_db) / radio.detection_slope_db))
    detected = (detection < chance) & ~lost
    spread = radio.spread_gain * speed * np.exp(radio.spread_sigma * scatter[:, 0])
    spread += radio.spread_floor_mps * np.abs(floor[:, 0])
    return snr, detected, bias, scene.hz_per_mps * spread


def moving_user(source, scene, dice):
    """Return a user's name (a string), and positions and velocities (T, 6)."""
    scenario = source.scenario
    T = source.epochs
    streets = scene.streets
    if isinstance(scenario, Trajectory):
        whole = scenario.resampled(source.dt)
        first = int(dice.uniform() * (len(whole) - T + 1))
        return scenario.name, whole[first : first + T]
    choices = mobilities_of(scenario)
    kind = int(len(choices) * dice.uniform())
    plan = plans_of(choices, streets.block_m)[kind]
    block = streets.block_m / plan.closer
    west, east = streets.x_m
    south, north = streets.y_m
    blocks = round((east - west) / block), round((north - south) / block)
    net = Net(block, *blocks, west, south, streets.height_m)
    phases = draw_phases(dice, plan.phases, T * source.dt)
    traveler = set_off(dice, phases, net)
    track = np.zeros((T, 6))
    stride = stride_of(source.dt)
    for row in track:
        row[:2], row[3:5] = state_of(traveler)
        for _ in range(stride):
            if traveler.due > 0.5:
                traveler = attend(dice, traveler, phases, net)
            traveler = move(traveler, net, source.dt / stride)
    track[:, 2] = streets.height_m
    return choices[kind].name, track


def plain(source, key):
    """Simulate the episode of a key, with formulas from the description of the model."""
    scene = source.scene
    radio = source.radio
    layout = source.layout
    T = source.epochs
    dice = PlainDice(key, USER)
    others = PlainDice(key, RECEIVER)
    if isinstance(scene, RandomScene):
        scene = scene.scene_of(scene.draw_numbers(dice))
    name, track = moving_user(source, scene, dice)
    first = others.normal()
    prior = others.many(others.normal, 7)
    position = track[:, :3]
    velocity = track[:, 3:]
    speed = np.linalg.norm(velocity, axis=1)
    z = geometry(position, velocity, scene, layout)
    distance = z[:, 0 : layout.doppler : 4]
    *draws, noise, drift = drawn(others, T, layout.anchors, layout.size)
    snr, detected, bias, spread = channel(radio, scene, distance, speed, source.dt, draws)
    sigma = radio.sigma(snr, scene, layout)
    z += sigma * noise
    z[:, : layout.doppler] += bias.reshape(T, -1)
    steps = radio.drift_mps * np.sqrt(source.dt) * drift[:-1, 0]
    offset = scene.hz_per_mps * np.cumsum([radio.prior_bias_mps * first, *steps])
    z[:, layout.doppler] += offset
    visible = np.column_stack([detected, detected[:, 0]])
    if source.odometry:
        visible = np.column_stack([visible, speed >= radio.odometry_slowest_mps])
    covariance = radio.prior_covariance(scene)
    mean = np.append(track[0], offset[0]) + np.sqrt(np.diag(covariance)) * prior
    times = source.dt * np.arange(T)
    measured = (z, sigma, visible, snr, spread)
    prior = mean, covariance
    site = scene.anchors_m, scene.hz_per_mps
    return Episode(name, *site, times, *measured, *prior, layout, position, velocity)


def wrapped_table(episode):
    """Return an episode's table; column 0 is dt, and the measured values follow."""
    table = episode.table()
    columns = 1 + np.array(episode.layout.angles)
    table[:, columns] = wrapped(table[:, columns])
    return table


@pytest.mark.parametrize("name", representative(SOURCES, "default", "jam"))
def test_a_key_gives_the_episode_of_the_plain_simulation(name):
    source = SOURCES[name]
    for key, episode in zip(KEYS, source.episodes(KEYS), strict=True):
        expected = plain(source, key)
        assert episode.name == expected.name
        assert_allclose(episode.time_s, expected.time_s)
        assert_allclose(episode.site(), expected.site(), rtol=1e-12, atol=1e-9)
        tables = [wrapped_table(e) for e in (episode, expected)]
        assert_allclose(*tables, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("threads", [1, 2])
def test_a_batch_equals_single_episodes_to_the_last_bit(name, threads):
    source = SOURCES[name]
    batch = source.sample_batch(KEYS, threads=threads)
    expected = EpisodeBatch.of([source.episode(int(key)) for key in KEYS])
    assert (batch.names, batch.layout) == (expected.names, expected.layout)
    # The steps of an episode are differences of its times, which are rounded.
    dt = columns_of(source.layout).dt
    assert_allclose(expected.table[..., dt], batch.table[..., dt], rtol=1e-12)
    expected.table[..., dt] = batch.table[..., dt]
    assert_same_fields(batch, expected, "length", "table", "site")


def test_a_random_generator_draws_the_key_of_a_sample():
    source = SOURCES["jam"]
    key = np.random.default_rng(7).integers(0, 2**64, dtype=np.uint64)
    assert_array_equal(sampled(source, 7).table(), source.episode(int(key)).table())


def test_the_scene_of_a_key_equals_the_scene_of_its_episode():
    source = SOURCES["random streets"]
    for key, episode in zip(KEYS, source.episodes(KEYS), strict=True):
        scene = source.scene_of(int(key))
        assert_allclose(scene.anchors_m, episode.scene_anchors_m, rtol=1e-12)
    assert SOURCES["jam"].scene_of(1) is SCENES["dynamic-doppler"]
