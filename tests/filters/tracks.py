"""Helpers that make episodes to filter, run engines on them and compare the tracks."""

from dataclasses import dataclass, replace
from operator import attrgetter
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import lfilter

from mmwave_env.engines.engine import Engine
from mmwave_env.filters import Mode, Pipeline, textbook
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.models.layout import MEASUREMENTS, Layout
from mmwave_env.models.measurement import exact_rows
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.episode import Episode
from mmwave_env.world.keys import keys_of
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import Trajectory
from tests.filters.gated_textbook import groups_of

STREET = Layout(3)
HZ_PER_MPS = 93.4


def wrapped(angles):
    """Return angles moved into [-pi, pi)."""
    return np.remainder(angles + np.pi, 2.0 * np.pi) - np.pi


def geometry(position, velocity, scene, layout):
    """Return the exact measurements (T, rows) at positions (T, 3) with velocities (T, 3)."""
    tracks = list(position.T), list(velocity.T)
    return np.stack(exact_rows(*tracks, scene.anchors_m, scene.hz_per_mps, layout), axis=1)


def street_source(scenario="mixed", radio="handset", **options):
    """Return a source of simulated episodes in the default street."""
    return SimulatedSource(SCENES["street"], RADIOS[radio], scenario, **options)


def sampled(source, seed=0):
    """Return the episode that a source draws with NumPy's generator of this seed."""
    return source.sample(np.random.default_rng(seed))


def drawn(seed, **options):
    """Return the episode of a seed in the default street."""
    return sampled(street_source(**options), seed)


def seeded(seed, **options):
    """Return the episode that an environment in the default street draws with this seed."""
    return street_source(**options).episode(int(keys_of([seed])[0]))


def simulated(n, epochs=200, odometry=False, seed=0, scene=SCENES["street"]):
    """Return n episodes of the noisiest radio, with more outliers and missing rows than usual."""
    source = SimulatedSource(scene, RADIOS["handset"], epochs=epochs, odometry=odometry)
    return [spoiled(sampled(source, [seed, i]), i) for i in range(n)]


def around_a_block():
    """Return a trajectory of 90 s along two sides of a block; speed and time step vary."""
    time_s = np.cumsum(np.tile([0.4, 1.0, 2.1, 0.8], 21)) + 1000.0
    passed = time_s - time_s[0]
    traveled = 2.0 * passed + 4.0 * np.sin(passed / 9.0)
    x = np.minimum(traveled, 80.0)
    y = np.maximum(traveled - 80.0, 0.0)
    position = np.column_stack([10.0 + x, -20.0 - y, np.full(len(x), 1.5)])
    return Trajectory("block", time_s, position)


def replay(episode):
    """Return an episode source that always returns ``episode``."""
    return SimpleNamespace(
        layout=episode.layout, epochs=len(episode), name=episode.name, sample=lambda rng: episode
    )


def spoiled(episode, seed):
    """Return a copy without a tenth of the groups of measurements; 1 % of its rows are far off."""
    rng = np.random.default_rng([99, seed])
    far = rng.random(episode.measurement.shape) < 0.01
    measurement = episode.measurement + 20.0 * far * episode.sigma
    angles = episode.layout.angles
    measurement[:, angles] = wrapped(measurement[:, angles])
    visible = episode.visible & (rng.random(episode.visible.shape) < 0.9)
    return replace(episode, measurement=measurement, visible=visible)


def some_rows(episode, rng, share):
    """Keep a random ``share`` of an episode's rows, and draw a ``doppler_anchor`` per epoch."""
    whole = episode.only(MEASUREMENTS)
    gone = rng.random(whole.measurement.shape) >= share
    measurement = np.where(gone, np.nan, whole.measurement)
    visible = np.logical_or.reduceat(np.isfinite(measurement), whole.layout.starts, axis=1)
    anchor = rng.integers(whole.layout.anchors, size=len(whole))
    return replace(whole, measurement=measurement, visible=visible, doppler_anchor=anchor)


def lasting(rng, n, columns, keep):
    """Return a stationary Gauss-Markov process (n, columns) of variance 1.

    ``keep`` is the correlation of neighboring numbers.
    """
    noise = rng.standard_normal((n, columns))
    noise[1:] *= np.sqrt(1.0 - keep**2)
    return lfilter([1.0], [1.0, -keep], noise, axis=0)


def process_noise(mode, dt=1.0, spread_hz=0.0, gamma=1.0, hz_per_mps=HZ_PER_MPS):
    """Return Q (7, 7) of a step, computed as documented: discrete white-noise acceleration."""
    velocity = np.square([mode.sigma_v, mode.sigma_v, mode.sigma_vz])
    velocity[:2] += mode.spread_gain * spread_hz
    position = np.square([mode.sigma_p, mode.sigma_p, mode.sigma_pz])
    q = velocity * dt
    half = 0.5 * dt * mode.coupling
    Q = np.diag([*(position * dt + q * half**2), *q, (mode.sigma_b_mps * hz_per_mps) ** 2 * dt])
    Q[range(3), range(3, 6)] = Q[range(3, 6), range(3)] = q * half
    return gamma * Q


@dataclass(frozen=True, eq=False)
class OwnModel:
    """Model of users whose start, motion and measurements are exactly as a filter assumes.

    ``start`` (7,) and ``prior`` (7,) are mean and standard deviations of the first state. Q (7, 7)
    is the process noise of one second. The noise has the standard deviations ``sigma`` (rows,).
    """

    sensor: textbook.Sensor
    start: np.ndarray
    prior: np.ndarray
    Q: np.ndarray
    sigma: np.ndarray

    def draw(self, rng, epochs):
        """Draw an episode with steps of 1 s."""
        sensor = self.sensor
        noise = np.linalg.cholesky(self.Q)
        x = [self.start + self.prior * rng.standard_normal(7)]
        for _ in range(epochs - 1):
            x.append(textbook.F(1.0) @ x[-1] + noise @ rng.standard_normal(7))
        x = np.array(x)
        sigma = np.tile(self.sigma, (epochs, 1))
        z = np.array([sensor.h(state) for state in x]) + sigma * rng.standard_normal(sigma.shape)
        z[:, sensor.angles] = wrapped(z[:, sensor.angles])
        visible = np.ones((epochs, len(groups_of(sensor))), bool)
        received = visible, np.full((epochs, sensor.links), 30.0), np.zeros(epochs)
        belief = (self.start, np.diag(self.prior**2))
        truth = (x[:, :3], x[:, 3:6])
        layout = Layout(sensor.links, sensor.odometry)
        where = (sensor.anchors, sensor.hz_per_mps)
        times = np.arange(epochs) * 1.0
        return Episode("own model", *where, times, z, sigma, *received, *belief, layout, *truth)


def far_from_the_anchors(Q):
    """Return an OwnModel whose measurements are nearly linear within the filters' uncertainty."""
    anchors = np.array([[-60.0, 120.0, 40.0], [160.0, 60.0, 60.0], [40.0, -150.0, 50.0]])
    return OwnModel(
        sensor=textbook.Sensor(anchors, HZ_PER_MPS),
        start=np.array([20.0, 10.0, 1.5, 1.0, -0.5, 0.0, 30.0]),
        prior=np.array([1.5, 1.5, 0.5, 1.0, 1.0, 0.1, 50.0]),
        Q=Q,
        sigma=np.array([0.5, 0.02, 0.02, 0.02] * 3 + [20.0]),
    )


def pipeline_of(layout=STREET, algorithms=("ekf", "ukf", "ckf"), planar=False, **tuning):
    """Return a pipeline with one mode per algorithm, all tuned alike."""
    modes = [Mode(a, a, **{"sigma_v": 1.8, **tuning}) for a in algorithms]
    return Pipeline(tuple(modes), layout, planar)


def track(pipeline, episodes, actions, epochs, parts, on_floats=False, bank=None):
    """Run an engine and record ``parts`` of its workspace, such as "memory.gamma", every epoch.

    Args:
        actions: (epochs, n) or (n,) modes to choose; with a bank, modes to make more probable.

    Returns:
        An array (epochs, n, ...) per part; "P_predicted" comes from a tracker, not an engine.
    """
    n = len(episodes)
    actions = np.broadcast_to(actions, (epochs, n))
    engine = Engine(pipeline, n, TrackingReward(), bank=bank, on_floats=on_floats)
    engine.load(episodes)
    engine.step()
    history = {name: [] for name in parts if name != "P_predicted"}
    for action in actions:
        engine.step(action)
        for name, values in history.items():
            values.append(engine.read(attrgetter(name)(engine.at)))
    arrays = {name: np.array(values) for name, values in history.items()}
    if "P_predicted" in parts:
        tracker = Engine(pipeline, n, observation="", on_floats=on_floats)
        tracker.load(episodes)
        predicted = tracker.run("P_predicted", actions=actions.T)["P_predicted"]
        arrays["P_predicted"] = predicted.swapaxes(0, 1)
    return arrays


def packed(P):
    """Return the lower triangles of symmetric matrices (..., n, n), as filters store them."""
    return P[(..., *np.tril_indices(P.shape[-1]))]


def unpacked(P):
    """Return symmetric matrices (..., n, n) from packed triangles, such as (..., 28) for n = 7."""
    n = int(np.sqrt(2 * P.shape[-1]))
    i, j = np.tril_indices(n)
    full = np.zeros((*P.shape[:-1], n, n))
    full[..., i, j] = full[..., j, i] = P
    return full


def nees_of(error, P):
    """Return the NEES (...,) of errors (..., k) in the first k states, given packed P (..., n)."""
    k = error.shape[-1]
    covariance = unpacked(P)[..., :k, :k]
    return np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariance), error)


def assert_same_fields(a, b, *fields):
    """Assert that two records have equal arrays in some fields."""
    for field in fields:
        assert_array_equal(getattr(a, field), getattr(b, field), field)


def assert_same_beliefs(a, b, rtol):
    """Assert that x and P of two tracks agree at every epoch, in units of standard deviations."""
    P = unpacked(a["P"])
    Q = unpacked(b["P"])
    sigma = np.sqrt(np.einsum("...ii->...i", Q))
    known = sigma == 0.0
    assert_array_equal(np.where(known, a["x"] - b["x"], 0.0), 0.0)
    unit = np.where(known, 1.0, sigma)
    assert_allclose((a["x"] - b["x"]) / unit, 0.0, atol=rtol)
    scale = unit[..., :, None] * unit[..., None, :]
    assert_allclose((P - Q) / scale, 0.0, atol=rtol)
