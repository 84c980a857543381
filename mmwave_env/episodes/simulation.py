"""An epoch of a simulated episode: the channel, then what a receiver measures.

Functions of numbers that run on lanes, an episode to a lane; all randomness comes in as draws.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mmwave_env.compiler.program import Program
from mmwave_env.episodes.episode import Incoming, blank_incoming
from mmwave_env.models.channel import (
    Channel,
    ChannelDraws,
    ChannelState,
    channel_epoch,
    channel_of,
    initial_state,
)
from mmwave_env.models.measurement import Layout, exact_rows
from mmwave_env.models.radio import Radio, deviations
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.arrays import Index
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Number, Vector, sqrt, where, wrap
from mmwave_env.numerics.pytree import flatten


class Draws(NamedTuple):
    """The randomness of an epoch, and where the user is.

    Attributes:
        truth: (6,) position (m) and velocity (m/s).
        channel: of the links.
        noise: (rows,) normals.
        drift: normal of the oscillator.
    """

    truth: list[Number]
    channel: ChannelDraws
    noise: list[Number]
    drift: Number


class EpisodeConstants(NamedTuple):
    """What stays the same through an episode.

    Attributes:
        anchors: (L, 3) positions, m.
        hz_per_mps: carrier frequency over the speed of light.
        channel: radio and scene.
        first_bias_mps, drift_mps: oscillator: standard deviation of the first bias, and of
            its change over a step.
    """

    anchors: list[list[Number]]
    hz_per_mps: Number
    channel: Channel
    first_bias_mps: Number
    drift_mps: Number


class Simulation(NamedTuple):
    """A simulated episode between two epochs.

    Attributes:
        draws: of the epoch.
        constants: where.
        is_first: 1 before the first epoch.
        channel_state: of the links.
        bias_mps: of the oscillator.
        measured: the epoch, as an engine loads it.
    """

    draws: Draws
    constants: EpisodeConstants
    is_first: Number
    channel_state: ChannelState
    bias_mps: Number
    measured: Incoming


def simulate_epoch(w: Simulation, layout: Layout) -> Simulation:
    """One epoch: the channel, then what a receiver measures."""
    constants, draws, is_first = w.constants, w.draws, w.is_first > 0.5
    position, velocity = draws.truth[:3], draws.truth[3:]
    speed = sqrt(dot(velocity, velocity))
    exact = exact_rows(position, velocity, constants.anchors, constants.hz_per_mps, layout)
    distance = [exact[layout.link(a)][0] for a in range(layout.anchors)]
    channel_state, reception = channel_epoch(
        constants.channel, w.channel_state, is_first, draws.channel, distance, speed
    )
    bias_mps = where(
        is_first,
        constants.first_bias_mps * draws.drift,
        w.bias_mps + constants.drift_mps * draws.drift,
    )
    bias_hz = constants.hz_per_mps * bias_mps
    c = constants.channel
    sigma = deviations(c.floor_variance, c.bound_variance, reception.snr_db, layout)
    added = [value for link in reception.bias for value in link] + [bias_hz]
    added += [0.0] * (layout.size - len(added))
    z = [e + s * n + b for e, s, n, b in zip(exact, sigma, draws.noise, added, strict=True)]
    z = [wrap(wrap(v)) if row in layout.angles else v for row, v in enumerate(z)]
    visible = [*reception.detected, reception.detected[0]]
    if layout.odometry:
        visible.append(where(speed < c.odometry_slowest_mps, 0.0, 1.0))
    measured = Incoming(
        dt=0.0,  # the same for all: filled in afterwards
        z=_where_seen(visible, z, 0.0, layout),
        signed_sigma=_where_seen(visible, sigma, -1.0, layout),
        snr_db=[
            where(v > 0.5, snr, 0.0) for v, snr in zip(visible, reception.snr_db, strict=False)
        ],
        doppler_spread_hz=reception.doppler_spread_hz,
        truth=list(draws.truth),
    )
    return w._replace(
        is_first=0.0,
        channel_state=channel_state,
        bias_mps=bias_mps,
        measured=measured,
    )


def _where_seen(visible: Vector, rows: Vector, otherwise: float, layout: Layout) -> list[Number]:
    """The rows (rows,) of the groups that are visible (groups,), else a constant."""
    seen = [v > 0.5 for v, group in zip(visible, layout.groups, strict=True)
            for _ in range(group.start, group.stop)]  # fmt: skip
    return [where(s, value, otherwise) for s, value in zip(seen, rows, strict=True)]


def _blank_draws(layout: Layout) -> Draws:
    L = layout.anchors
    each, angles = [0.0] * L, [[0.0] * 3] * L
    channel = ChannelDraws(each, each, each, 0.0, each, each, angles, angles, each, 0.0, 0.0)
    return Draws([0.0] * 6, channel, [0.0] * layout.size, 0.0)


@lru_cache(maxsize=8)
def program_of(layout: Layout) -> Program[Simulation]:
    """:func:`simulate_epoch` for lanes."""
    rows, L = layout.size, layout.anchors
    radio, scene = Radio("blank"), Scene("blank", (0.0, 0.0, 10.0))
    channel = channel_of(radio, scene, layout, 1.0)
    anchors = [[0.0, 0.0, 10.0 + a] for a in range(L)]
    template = Simulation(
        draws=_blank_draws(layout),
        constants=EpisodeConstants(anchors, 1.0, channel, 1.0, 1.0),
        is_first=1.0,
        channel_state=initial_state(L),
        bias_mps=0.0,
        measured=blank_incoming(layout),
    )
    assert len(flatten(channel.floor_variance)) == rows

    def function(w: Simulation) -> Simulation:
        return simulate_epoch(w, layout)

    return Program(function, template)


@lru_cache(maxsize=8)
def kept_rows(layout: Layout) -> Index:
    """The rows that are kept of every epoch: as measured."""
    return np.array(flatten(program_of(layout).index.measured))
