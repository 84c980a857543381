"""Simulated episodes against a plain numpy simulation that draws the same random numbers.

It is the meaning of a seed: kinds of draws in this order, each over all epochs at once.
"""

import threading

import numpy as np
import pytest

from mmwave_env.compiler.rng import Generators
from mmwave_env.episodes import simulated
from mmwave_env.episodes.drawing import _draw
from mmwave_env.episodes.episode import Episode, EpisodeBatch
from mmwave_env.episodes.mobility import mobilities_of, nets_of, plan_of
from mmwave_env.episodes.simulated import CHUNK, SimulatedSource
from mmwave_env.episodes.simulation import program_of
from mmwave_env.episodes.trajectory import Trajectory
from mmwave_env.models.measurement import Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import SCENES
from mmwave_env.numerics.pytree import flatten, unflatten
from tests.episodes.roads import around_a_block, trajectories
from tests.filters.tracks import geometry

SOURCES = {
    "default": SimulatedSource(SCENES["street"], RADIOS["handset"]),
    "odometry at 10 Hz": SimulatedSource(
        SCENES["o1"], RADIOS["high"], "walk-ride", dt=0.1, odometry=True
    ),
    "jam": SimulatedSource(SCENES["dynamic-doppler"], RADIOS["standard"], "jam", 0.5, epochs=77),
    "windows of a way": SimulatedSource(
        SCENES["street"], RADIOS["handset"], around_a_block(), dt=0.7, epochs=30, odometry=True
    ),
    "streets at random": SimulatedSource(RandomScene(), RADIOS["standard"], epochs=60),
    "a whole way": SimulatedSource(SCENES["o1"], RADIOS["high"], around_a_block([200.0, 600.0])),
}


def spells(uniform, onset, leave, first):
    """A two-state Markov chain per column: whether it is on, and since which epoch."""
    on, since = np.zeros(uniform.shape, bool), np.zeros(uniform.shape, int)
    for t, draw in enumerate(uniform):
        before = on[t - 1] if t else np.zeros(uniform.shape[1], bool)
        on[t] = np.where(before, draw >= leave, draw < (onset[t] if t else first))
        since[t] = np.where(before, since[t - 1], t)
    return on, since


def channel(radio, scene, distance, speed, dt, rng):
    """SNR, detection, biases (T, L, 4) and Doppler spread."""
    T, L = distance.shape
    link = np.arange(L)
    loss = 32.4 + 21 * np.log10(distance) + 20 * np.log10(scene.carrier_hz / 1e9)
    loss[:, 1:] += radio.reflection_loss_db
    shadow, rho = rng.standard_normal((T, L)), radio.shadowing_correlation**dt
    for t in range(1, T):
        shadow[t] = rho * shadow[t - 1] + np.sqrt(1 - rho**2) * shadow[t]
    share = radio.blockage_scale * np.minimum(
        radio.blockage_limit, radio.blockage_base + radio.blockage_per_100m * distance / 100
    )
    leave = 1 - np.exp(-dt / radio.blockage_mean_s)
    blocked, begun = spells(rng.random((T, L)), leave * share / (1 - share), leave, share[0])
    rate, end = (1 - np.exp(-dt * r) for r in (radio.multipath_rate_hz, 1 / radio.multipath_mean_s))
    reflected, arrived = spells(rng.random((T, L)), np.full((T, L), rate), end, np.zeros(L))
    rate, end = (1 - np.exp(-dt * r) for r in (radio.outage_rate_hz, 1 / radio.outage_mean_s))
    lost, _ = spells(rng.random((T, 1)), np.full((T, 1), rate), end, np.zeros(1))
    blockage = radio.blockage_range_m * rng.standard_exponential((T, L))
    constant, mean = radio.multipath_range_m
    multipath = constant + mean * rng.standard_exponential((T, L))
    angles = rng.standard_normal((2, T, L, 3))
    bias = np.zeros((T, L, 4))
    bias[..., 0] = blocked * blockage[begun, link] + reflected * multipath[arrived, link]
    bias[..., 1:] = blocked[..., None] * radio.blockage_angle_rad * angles[0, begun, link]
    bias[..., 1:] += reflected[..., None] * radio.multipath_angle_rad * angles[1, arrived, link]
    gain = -loss + radio.shadowing_db * shadow - radio.blockage_loss_db * blocked
    snr = radio.snr_db(gain, scene.bandwidth_hz)
    chance = 1 / (1 + np.exp(-(snr - radio.detection_snr_db) / radio.detection_slope_db))
    detected = (rng.random((T, L)) < chance) & ~lost
    scatter = np.exp(radio.spread_sigma * rng.standard_normal(T))
    floor = radio.spread_floor_mps * np.abs(rng.standard_normal(T))
    return snr, detected, bias, scene.hz_per_mps * (radio.spread_gain * speed * scatter + floor)


def way(source, streets, rng):
    """The name of a user, and its positions and velocities (T, 6)."""
    scenario, T = source.scenario, source.epochs
    if isinstance(scenario, Trajectory):
        whole = scenario.resampled(source.dt)
        first = int(rng.random() * (len(whole) - T + 1))
        return scenario.name, whole[first : first + T]
    choices = mobilities_of(scenario)
    mobility = choices[int(rng.random() * len(choices))]
    tracks = np.empty((1, T, 6))
    plan, nets = plan_of([mobility], streets.block_m), nets_of([mobility], [streets])
    trajectories(plan, nets, [0], source.dt, [rng], tracks)
    return mobility.name, tracks[0]


def plain(source, rng):
    """An episode, straight from the model's description."""
    scene, radio, layout, T = source.scene, source.radio, source.layout, source.epochs
    if isinstance(scene, RandomScene):
        scene = scene.draw(rng)
    name, track = way(source, scene.streets, rng)
    position, velocity = track[:, :3], track[:, 3:]
    speed = np.linalg.norm(velocity, axis=1)
    z = geometry(position, velocity, scene, layout)
    distance = z[:, 0 : layout.doppler : 4]
    snr, detected, bias, spread = channel(radio, scene, distance, speed, source.dt, rng)
    sigma = radio.sigma(snr, scene, layout)
    z += sigma * rng.standard_normal(z.shape)
    z[:, : layout.doppler] += bias.reshape(T, -1)
    steps = np.full(T, radio.drift_mps * np.sqrt(source.dt))
    steps[0] = radio.prior_bias_mps
    drift = scene.hz_per_mps * np.cumsum(steps * rng.standard_normal(T))
    z[:, layout.doppler] += drift
    visible = np.column_stack([detected, detected[:, 0]])
    if source.odometry:
        visible = np.column_stack([visible, speed >= radio.odometry_slowest_mps])
    covariance = radio.prior_covariance(scene)
    state = np.concatenate([track[0], drift[:1]])
    return Episode(
        name, scene.anchors_m, scene.hz_per_mps, source.dt * np.arange(T), z, sigma,
        visible, snr, spread, state + np.sqrt(np.diag(covariance)) * rng.standard_normal(7),
        covariance, position, velocity, layout,
    )  # fmt: skip


def wrapped(table, layout):
    """The table with its angles, which follow dt, moved into [-pi, pi)."""
    columns = 1 + np.array(layout.angles)
    table[..., columns] = np.remainder(table[..., columns] + np.pi, 2 * np.pi) - np.pi
    return table


@pytest.mark.parametrize("name", SOURCES)
def test_a_seed_means_the_episode_of_the_plain_simulation(name):
    source = SOURCES[name]
    for seed in range(20):
        ours, theirs = np.random.default_rng(seed), np.random.default_rng(seed)
        episode, expected = source.sample(ours), plain(source, theirs)
        assert ours.random() == theirs.random()  # as many draws
        assert episode.name == expected.name
        np.testing.assert_allclose(episode.time_s, expected.time_s)
        np.testing.assert_allclose(episode.site(), expected.site(), rtol=1e-12, atol=1e-12)
        tables = [wrapped(e.table(), source.layout) for e in (episode, expected)]
        np.testing.assert_allclose(*tables, rtol=1e-9, atol=1e-9)


class Kinds:
    """A generator whose draws tell their kind."""

    NORMAL, UNIFORM, EXPONENTIAL = 1.0, 2.0, 3.0

    def standard_normal(self):
        return self.NORMAL

    def random(self):
        return self.UNIFORM

    def standard_exponential(self):
        return self.EXPONENTIAL


NEEDED = {  # by the fields of Draws and of ChannelDraws
    "truth": 0.0,  # is there before
    "shadowing": Kinds.NORMAL,
    "blockage": Kinds.UNIFORM,
    "multipath": Kinds.UNIFORM,
    "outage": Kinds.UNIFORM,
    "blockage_range": Kinds.EXPONENTIAL,
    "multipath_range": Kinds.EXPONENTIAL,
    "blockage_angles": Kinds.NORMAL,
    "multipath_angles": Kinds.NORMAL,
    "detection": Kinds.UNIFORM,
    "scatter": Kinds.NORMAL,
    "floor": Kinds.NORMAL,
    "noise": Kinds.NORMAL,
    "drift": Kinds.NORMAL,
}


@pytest.mark.parametrize("layout", [Layout(1), Layout(3), Layout(3, odometry=True)], ids=str)
def test_draws_fill_the_fields_that_need_their_kind(layout):
    """The columns are filled in one file and named in another."""
    blank = program_of(layout).template.draws
    columns = np.zeros((4, len(flatten(blank))))
    _draw(Kinds(), columns, layout.anchors, layout.size)
    for epoch in columns:
        draws = unflatten(blank, iter(epoch.tolist()))
        fields = draws._asdict() | draws.channel._asdict()
        del fields["channel"]
        kinds = {name: set(flatten(field)) for name, field in fields.items()}
        assert kinds == {name: {kind} for name, kind in NEEDED.items()}


def seeded(n):
    """Generators of n environments."""
    generators = Generators(n)
    for place in range(n):
        generators.seed(place, place)
    return generators


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("n", [1, 8, 21])
def test_a_batch_is_the_episodes_one_by_one_to_the_bit(name, n):
    source, ours = SOURCES[name], seeded(n)
    theirs = ours.copies()
    with ours.states(np.arange(n)) as states:
        found = source.sample_batch(states)
    expected = EpisodeBatch.of([source.sample(rng) for rng in theirs])
    assert (found.names, found.layout) == (expected.names, expected.layout)
    for field in ("nonfinite", "length", "table", "site"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    for a, b in zip(ours.copies(), theirs, strict=True):
        assert a.bit_generator.state == b.bit_generator.state


def test_tables_go_where_they_are_wanted():
    source, tables = SOURCES["jam"], np.zeros((5, 77, 37))
    with seeded(3).states(np.arange(3)) as states:
        expected = source.sample_batch(states.copy()).table
        returned = source.sample_batch(states, out=tables[1:4]).table
    np.testing.assert_array_equal(tables[1:4], expected)
    assert np.shares_memory(returned, tables)
    assert not tables[0].any() and not tables[4].any()


@pytest.mark.parametrize(
    ("out", "found"),
    [
        (np.zeros((2, 77, 37)), "(2, 77, 37)"),
        (np.zeros((1, 77, 36)), "(1, 77, 36)"),
        (np.zeros((1, 77, 74))[..., ::2], "contiguous False"),
    ],
)
def test_where_tables_do_not_fit_is_refused(out, found):
    with pytest.raises(ValueError, match="out: found .*expected .1, 77, 37., contiguous") as error:
        SOURCES["jam"].sample_batch(np.ones((1, 4), np.uint64), out)
    assert found in str(error.value)


def test_threads_do_not_choose_each_for_itself_whether_to_compile(monkeypatch):
    """Else some would compile, and hold the interpreter, while others run as plain Python."""
    choose, works = simulated.simulate.choice, []

    def choice(work, *arguments):
        works.append((work, threading.get_ident()))
        return choose(work, *arguments)

    monkeypatch.setattr(simulated.simulate, "choice", choice)
    source, n = SimulatedSource(SCENES["street"], RADIOS["handset"], epochs=3), 3 * CHUNK + 5
    generators = Generators(n)
    with generators.states(np.arange(n)) as states:
        source.sample_batch(states, threads=2)
    assert works == [(n * source.epochs, threading.get_ident())]
