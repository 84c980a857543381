"""Simulated episodes: a user in the streets, seen through a channel.

All randomness of an episode is drawn first, in one go and from the episode's own generator.
What follows is arithmetic: functions of numbers that run on lanes, an episode to a lane.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import chain
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from mmwave_env.arithmetic import Number, Vector, sqrt, where, wrap
from mmwave_env.channel import Channel, ChannelDraws, Weather, calm, channel_epoch, channel_of
from mmwave_env.disk_cache import compiled
from mmwave_env.episode import Episode, Packed
from mmwave_env.estimator.algebra import dot
from mmwave_env.estimator.batch import Incoming, blank_incoming
from mmwave_env.estimator.lanes import WIDTH
from mmwave_env.estimator.program import Index, Program, Tracks, Traffic
from mmwave_env.estimator.trees import leaves
from mmwave_env.measurement import STATE_SIZE, Layout, exact_rows
from mmwave_env.mobility import mobilities_of, plan_of
from mmwave_env.radio import Radio, deviations
from mmwave_env.scene import Scene
from mmwave_env.threads import share
from mmwave_env.travel import Plan, trajectories

Array = NDArray[np.float64]

CHUNK = 16  # episodes drawn at once: few enough for their draws to stay in the caches


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


class World(NamedTuple):
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
        world: where.
        fresh: 1 before the first epoch.
        weather: of the links.
        bias_mps: of the oscillator.
        measured: the epoch, as an engine loads it.
    """

    draws: Draws
    world: World
    fresh: Number
    weather: Weather
    bias_mps: Number
    measured: Incoming


def simulate_epoch(w: Simulation, layout: Layout) -> Simulation:
    """One epoch: the channel, then what a receiver measures."""
    world, draws, fresh = w.world, w.draws, w.fresh > 0.5
    position, velocity = draws.truth[:3], draws.truth[3:]
    speed = sqrt(dot(velocity, velocity))
    exact = exact_rows(position, velocity, world.anchors, world.hz_per_mps, layout)
    distance = [exact[layout.link(a)][0] for a in range(layout.anchors)]
    weather, reception = channel_epoch(
        world.channel, w.weather, fresh, draws.channel, distance, speed
    )
    bias_mps = where(
        fresh, world.first_bias_mps * draws.drift, w.bias_mps + world.drift_mps * draws.drift
    )
    bias_hz = world.hz_per_mps * bias_mps
    c = world.channel
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
        fresh=0.0,
        weather=weather,
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
def _program(layout: Layout) -> Program[Simulation]:
    rows, L = layout.size, layout.anchors
    radio, scene = Radio("blank"), Scene("blank", (0.0, 0.0, 10.0))
    channel = channel_of(radio, scene, layout, 1.0)
    anchors = [[0.0, 0.0, 10.0 + a] for a in range(L)]
    template = Simulation(
        draws=_blank_draws(layout),
        world=World(anchors, 1.0, channel, 1.0, 1.0),
        fresh=1.0,
        weather=calm(L),
        bias_mps=0.0,
        measured=blank_incoming(layout),
    )
    assert len(leaves(channel.floor_variance)) == rows

    def function(w: Simulation) -> Simulation:
        return simulate_epoch(w, layout)

    return Program(function, template)


def _kept(layout: Layout) -> Index:
    """The rows that are kept of every epoch: as measured."""
    return np.array(leaves(_program(layout).index.measured))


@numba.njit
def _normals(rng, out, first, last):  # type: ignore[no-untyped-def]
    for epoch in range(len(out)):
        for i in range(first, last):
            out[epoch, i] = rng.standard_normal()
    return last


@numba.njit
def _uniforms(rng, out, first, last):  # type: ignore[no-untyped-def]
    for epoch in range(len(out)):
        for i in range(first, last):
            out[epoch, i] = rng.random()
    return last


@numba.njit
def _exponentials(rng, out, first, last):  # type: ignore[no-untyped-def]
    for epoch in range(len(out)):
        for i in range(first, last):
            out[epoch, i] = rng.standard_exponential()
    return last


@compiled
def _draw(rng, out, links, rows):  # type: ignore[no-untyped-def]
    """Fill (T, draws) after the truth, in the order of the leaves of :class:`Draws`.

    The order of drawing, kind by kind over all epochs, is part of what a seed means.
    """
    at = _normals(rng, out, 6, 6 + links)  # shadowing
    at = _uniforms(rng, out, at, at + links)  # blockage
    at = _uniforms(rng, out, at, at + links)  # multipath
    at = _uniforms(rng, out, at, at + 1)  # outage
    at = _exponentials(rng, out, at, at + links)  # range of blockage
    at = _exponentials(rng, out, at, at + links)  # of multipath
    at = _normals(rng, out, at, at + 3 * links)  # angles of blockage
    at = _normals(rng, out, at, at + 3 * links)  # of multipath
    at = _uniforms(rng, out, at, at + links)  # detection
    at = _normals(rng, out, at, at + 1)  # scatter of the Doppler spread
    at = _normals(rng, out, at, at + 1)  # its floor
    at = _normals(rng, out, at, at + rows)  # noise
    _normals(rng, out, at, at + 1)  # oscillator


@dataclass(frozen=True)
class SimulatedSource:
    """Episodes of simulated users in a street scene.

    Attributes:
        scene: geometry and carrier.
        radio: noise, blockage, multipath.
        scenario: kind of user, or "mixed".
        dt: seconds between epochs.
        epochs: length of an episode.
        odometry: whether the user also reports speed and heading.
    """

    scene: Scene
    radio: Radio
    scenario: str = "mixed"
    dt: float = 1.0
    epochs: int = 200
    odometry: bool = False

    def __post_init__(self) -> None:
        mobilities_of(self.scenario)
        self.scene.require_streets_in_front()
        if not 0.0 < self.dt < float("inf"):
            raise ValueError(f"dt: found {self.dt}, expected a positive number of seconds")
        if self.epochs < 1:
            raise ValueError(f"epochs: found {self.epochs}, expected at least 1")

    @cached_property
    def layout(self) -> Layout:
        """Rows of every episode's measurements."""
        return Layout(len(self.scene.anchors_m), self.odometry)

    @property
    def time_s(self) -> Array:
        """(epochs,) of every episode."""
        return self.dt * np.arange(self.epochs, dtype=np.float64)

    @property
    def name(self) -> str:
        """The scenario, and the scene where it is not the default street."""
        scene = self.scene.name
        return self.scenario if scene == "street" else f"{self.scenario} on {scene}"

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw one episode; all randomness comes from ``rng``."""
        names, tables, priors = self.tables([rng])
        rows, links, table = self.layout.size, self.layout.anchors, tables[0]
        _, z, signed_sigma, snr_db, spread, truth = np.split(
            table, np.cumsum([1, rows, rows, links, 1]), axis=1
        )
        starts = [group.start for group in self.layout.groups]
        return Episode(
            name=names[0],
            scene_anchors_m=self.scene.anchors_m,
            hz_per_mps=self.scene.hz_per_mps,
            time_s=self.time_s,
            measurement=z.copy(),
            sigma=np.abs(signed_sigma),
            visible=signed_sigma[:, starts] > 0.0,
            snr_db=snr_db.copy(),
            doppler_spread_hz=spread[:, 0].copy(),
            prior_mean=priors[0],
            prior_covariance=self.radio.prior_covariance(self.scene),
            truth_position_m=truth[:, :3].copy(),
            truth_velocity_mps=truth[:, 3:].copy(),
            layout=self.layout,
        )

    def packed(
        self, rngs: Sequence[np.random.Generator], out: Array | None = None, threads: int = 1
    ) -> Packed:
        """Draw an episode from each generator, the same as :meth:`sample` would.

        Args, errors: as :meth:`tables` has them.
        """
        names, table, prior = self.tables(rngs, out, threads)
        n, scene = len(rngs), self.scene
        fixed = np.append(scene.anchors_m.ravel(), scene.hz_per_mps)
        covariance = self.radio.prior_covariance(scene)[np.tril_indices(STATE_SIZE)]
        return Packed(
            names=names,
            nonfinite=np.zeros(n, np.int64),
            length=np.full(n, self.epochs),
            table=table,
            site=np.hstack([np.tile(fixed, (n, 1)), prior, np.tile(covariance, (n, 1))]),
            layout=self.layout,
        )

    def tables(
        self, rngs: Sequence[np.random.Generator], out: Array | None = None, threads: int = 1
    ) -> tuple[list[str], Array, Array]:
        """Draw an episode from each generator, mostly without the interpreter's lock.

        Args:
            rngs: (n,) generators.
            out: (n, epochs, columns) to fill, C-contiguous; None for a new array.
            threads: how many may draw at once.


        Args:
            rngs: one an episode.
            threads: how many may draw at once.

        Returns:
            Their names; ``out``, with columns as :meth:`~mmwave_env.episode.Episode.table` has
            them; (n, 7) means of the priors.


        Raises:
            ValueError: ``out`` has another shape, or gaps.
        """
        n, keep = len(rngs), _kept(self.layout)
        out = np.empty((n, self.epochs, len(keep))) if out is None else out
        if out.shape != (n, self.epochs, len(keep)) or not out.flags.c_contiguous:
            raise ValueError(
                f"out: found shape {out.shape}, contiguous {out.flags.c_contiguous}, expected "
                f"{(n, self.epochs, len(keep))}, contiguous True"
            )
        priors = np.empty((n, STATE_SIZE))
        chunks = [slice(first, first + CHUNK) for first in range(0, n, CHUNK)]
        jobs = [(rngs[some], keep, out[some], priors[some]) for some in chunks]
        return list(chain(*share(self._fill, jobs, threads))), out, priors

    def _fill(
        self, rngs: Sequence[np.random.Generator], keep: Index, out: Array, priors: Array
    ) -> list[str]:
        """Fill tables and means of priors as :meth:`tables` returns them; their names."""
        layout, program, n = self.layout, _program(self.layout), len(rngs)
        choices = mobilities_of(self.scenario)
        kinds = [int(rng.random() * len(choices)) for rng in rngs]
        draws = np.empty((n, self.epochs, len(program.blank)))
        trajectories(self._plan, kinds, self.dt, rngs, draws)
        for rng, drawn, prior in zip(rngs, draws, priors, strict=True):
            _draw(rng, drawn, layout.anchors, layout.size)
            prior[:] = rng.standard_normal(STATE_SIZE)
        rows = np.tile(self._start[None, :, None], (-(-n // WIDTH), 1, WIDTH))
        traffic = Traffic.of(n, self.epochs, keep=keep)._replace(kept=out)
        program.run_on_lanes(Tracks.of(draws, rows), traffic)
        out[:, 1:, 0] = np.diff(self.time_s)
        first_bias_hz = self.scene.hz_per_mps * (self.radio.prior_bias_mps * draws[:, 0, -1:])
        priors *= np.sqrt(np.diag(self.radio.prior_covariance(self.scene)))
        priors += np.concatenate([draws[:, 0, :6], first_bias_hz], axis=1)
        return [choices[kind].name for kind in kinds]

    @cached_property
    def _plan(self) -> Plan:
        return plan_of(mobilities_of(self.scenario), self.scene.streets)

    @cached_property
    def _start(self) -> Array:
        """The workspace (size,) of an episode before its first epoch."""
        radio, scene = self.radio, self.scene
        world = World(
            anchors=scene.anchors_m.tolist(),
            hz_per_mps=scene.hz_per_mps,
            channel=channel_of(radio, scene, self.layout, self.dt),
            first_bias_mps=radio.prior_bias_mps,
            drift_mps=radio.drift_mps * self.dt**0.5,
        )
        return np.array(leaves(_program(self.layout).template._replace(world=world)), float)
