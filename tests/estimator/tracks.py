"""Episodes to filter, and whole tracks of an engine to compare."""

from dataclasses import replace
from operator import attrgetter

import numpy as np

from mmwave_env.engine import Engine
from mmwave_env.episode import SimulatedSource
from mmwave_env.estimator.modes import Mode
from mmwave_env.estimator.pipeline import Pipeline
from mmwave_env.measurement import Layout
from mmwave_env.radio import RADIOS
from mmwave_env.reward import TrackingReward
from mmwave_env.scene import SCENES

STREET = Layout(3)
TRIANGLE = np.tril_indices(7)


def simulated(n, epochs=200, odometry=False, seed=0):
    """Episodes of the noisiest radio, with more missing groups and gross outliers on top."""
    source = SimulatedSource(SCENES["street"], RADIOS["handset"], epochs=epochs, odometry=odometry)
    return [spoiled(source.sample(np.random.default_rng([seed, i])), i) for i in range(n)]


def spoiled(episode, seed):
    """The episode with a tenth of its groups missing and one row in a hundred far off."""
    rng = np.random.default_rng([99, seed])
    far = rng.random(episode.measurement.shape) < 0.01
    measurement = episode.measurement + 20.0 * far * episode.sigma
    angles = episode.layout.angles
    measurement[:, angles] = np.remainder(measurement[:, angles] + np.pi, 2 * np.pi) - np.pi
    visible = episode.visible & (rng.random(episode.visible.shape) < 0.9)
    return replace(episode, measurement=measurement, visible=visible)


def with_anchors(episode, anchors):
    """The episode with its first anchors alone."""
    old = episode.layout
    rows = [*range(4 * anchors), *range(old.doppler, old.size)]
    groups = [*range(anchors), *range(old.anchors, len(old.groups))]
    return replace(
        episode,
        scene_anchors_m=episode.scene_anchors_m[:anchors],
        measurement=episode.measurement[:, rows],
        sigma=episode.sigma[:, rows],
        visible=episode.visible[:, groups],
        snr_db=episode.snr_db[:, :anchors],
        layout=Layout(anchors, old.odometry),
    )


def pipeline_of(layout=STREET, algorithms=("ekf", "ukf", "ckf"), planar=False, **tuning):
    """One mode per algorithm, all tuned alike."""
    modes = [Mode(a, a, **{"sigma_v": 1.8, **tuning}) for a in algorithms]
    return Pipeline(tuple(modes), layout, planar)


def track(pipeline, episodes, actions, epochs, what, on_floats=False):
    """Run an engine; ``what`` names parts of its workspace to keep, such as "memory.gamma".

    Args:
        actions: (epochs, n) or (n,) modes to commit to.

    Returns:
        Per name an array (epochs, n, ...).
    """
    engine = Engine(pipeline, len(episodes), TrackingReward(), on_floats=on_floats)
    engine.reset(episodes)
    history = {name: [] for name in what}
    for action in np.broadcast_to(actions, (epochs, len(episodes))):
        engine.step(action)
        for name, values in history.items():
            values.append(engine.read(attrgetter(name)(engine.at)))
    return {name: np.array(values) for name, values in history.items()}


def unpacked(P):
    """Symmetric matrices (..., 7, 7) from packed triangles (..., 28)."""
    full = np.zeros((*P.shape[:-1], 7, 7))
    full[..., TRIANGLE[0], TRIANGLE[1]] = P
    full[..., TRIANGLE[1], TRIANGLE[0]] = P
    return full


def assert_same_beliefs(a, b, rtol):
    """Tracks with x and P agree at every epoch, in units of their standard deviations."""
    P, Q = unpacked(a["P"]), unpacked(b["P"])
    sigma = np.sqrt(np.einsum("...ii->...i", Q))
    known = sigma == 0.0
    np.testing.assert_array_equal(np.where(known, a["x"] - b["x"], 0.0), 0.0)
    unit = np.where(known, 1.0, sigma)
    np.testing.assert_allclose((a["x"] - b["x"]) / unit, 0.0, atol=rtol)
    scale = unit[..., :, None] * unit[..., None, :]
    np.testing.assert_allclose((P - Q) / scale, 0.0, atol=rtol)
