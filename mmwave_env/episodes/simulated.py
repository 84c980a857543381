"""Simulated episodes: a user in the streets, seen through a channel.

All randomness of an episode is drawn first, in one go and from the episode's own generator.
What follows is arithmetic: functions of numbers that run on lanes, an episode to a lane.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.compiler.program import Program
from mmwave_env.compiler.rng import RngView, Words, rng_view, whole_rng
from mmwave_env.compiler.threads import portions, share
from mmwave_env.episodes.drawing import simulate
from mmwave_env.episodes.episode import Episode, EpisodeBatch, Incoming, blank_incoming, columns_of
from mmwave_env.episodes.kinematics import motion
from mmwave_env.episodes.mobility import MIXED, Mobility, mobilities_of, plan_of
from mmwave_env.episodes.trajectory import Trajectory, read_trajectory
from mmwave_env.episodes.travel import TravelPlan, stride_of
from mmwave_env.models.channel import (
    Channel,
    ChannelDraws,
    ChannelState,
    channel_epoch,
    channel_of,
    initial_state,
)
from mmwave_env.models.epoch import Site
from mmwave_env.models.measurement import STATE_SIZE, Layout, exact_rows
from mmwave_env.models.radio import Radio, deviations
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.arrays import Array, Index
from mmwave_env.numerics.linalg import dot
from mmwave_env.numerics.numbers import Number, Vector, sqrt, where, wrap
from mmwave_env.numerics.pytree import flatten, indices

Scenario = str | os.PathLike[str] | Mobility | Trajectory

CHUNK = 64  # episodes a thread draws at once, at most


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
def _program(layout: Layout) -> Program[Simulation]:
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
def _kept(layout: Layout) -> Index:
    """The rows that are kept of every epoch: as measured."""
    return np.array(flatten(_program(layout).index.measured))


@dataclass(frozen=True)
class SimulatedSource:
    """Episodes of simulated users in a street scene.

    Attributes:
        scene: geometry and carrier.
        radio: noise, blockage, multipath.
        scenario: kind of user: a name, "mixed", a JSON file or a Mobility; or the way of one: a CSV
            file or a Trajectory.
        dt: seconds between epochs.
        epochs: length of an episode; at most, of a trajectory: a window that is drawn, or all of
            one that is shorter.
        odometry: whether the user also reports speed and heading.
    """

    scene: Scene
    radio: Radio
    scenario: Scenario = "mixed"
    dt: float = 1.0
    epochs: int = 200
    odometry: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.dt < float("inf"):
            raise ValueError(f"dt: found {self.dt}, expected a positive number of seconds")
        if self.epochs < 1:
            raise ValueError(f"epochs: found {self.epochs}, expected at least 1")
        if len(self._plan.way):
            object.__setattr__(self, "epochs", min(self.epochs, len(self._plan.way)))

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
        users, scene = self._users, self.scene.name
        many = isinstance(users, tuple) and len(users) > 1
        who = MIXED if many else self._names[0]
        return who if scene == "street" else f"{who} on {scene}"

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw one episode; all randomness comes from ``rng``."""
        tables = np.empty((1, self.epochs, len(_kept(self.layout))))
        names, priors = self._fill(tables, lambda _: whole_rng(rng), [slice(None)])
        at = columns_of(self.layout)

        def columns(of: Any) -> Array:
            return np.ascontiguousarray(tables[0][:, of])

        signed_sigma = columns(at.signed_sigma)
        starts = [group.start for group in self.layout.groups]
        return Episode(
            name=names[0],
            scene_anchors_m=self.scene.anchors_m,
            hz_per_mps=self.scene.hz_per_mps,
            time_s=self.time_s,
            measurement=columns(at.z),
            sigma=np.abs(signed_sigma),
            visible=signed_sigma[:, starts] > 0.0,
            snr_db=columns(at.snr_db),
            doppler_spread_hz=columns(at.doppler_spread_hz),
            prior_mean=priors[0],
            prior_covariance=self.radio.prior_covariance(self.scene),
            truth_position_m=columns(at.truth[:3]),
            truth_velocity_mps=columns(at.truth[3:]),
            layout=self.layout,
        )

    def sample_batch(
        self, states: Words, out: Array | None = None, threads: int = 1
    ) -> EpisodeBatch:
        """Draw an episode from each state, as :meth:`sample` would from a generator.

        Args:
            states: (n, 4) of PCG64, changed in place.
            out: (n, epochs, columns) to fill and return, C-contiguous; None for a new array.
            threads: how many may draw at once.

        Raises:
            ValueError: ``out`` has another shape, or gaps.
        """
        n = len(states)
        shape = (n, self.epochs, len(_kept(self.layout)))
        table = np.empty(shape) if out is None else out
        if table.shape != shape or not table.flags.c_contiguous:
            raise ValueError(
                f"out: found shape {table.shape}, contiguous {table.flags.c_contiguous}, expected "
                f"{shape}, contiguous True"
            )
        parts = portions(n, threads, CHUNK)
        names, priors = self._fill(table, lambda some: rng_view(states[some]), parts, threads)
        site, mean = self._site
        sites = np.empty((n, len(site)))
        sites[:], sites[:, mean] = site, priors
        return EpisodeBatch(
            names=names,
            nonfinite=np.zeros(n, np.int64),
            length=np.full(n, self.epochs),
            table=table,
            site=sites,
            layout=self.layout,
        )

    def _fill(
        self,
        tables: Array,
        view: Callable[[slice], RngView],
        parts: Sequence[slice],
        threads: int = 1,
    ) -> tuple[list[str], Array]:
        """Fill tables (n, epochs, columns); the names, and the means (n, 7) of the priors.

        Before the threads begin, motion and program are compiled, and it is chosen for all of
        them whether the drawing is: else some would repeat, or wait for, what others compile.

        Args:
            tables: to fill.
            view: gives a thread what to draw a part from.
            parts: of the tables, each drawn by one thread.
            threads: how many may draw at once.
        """
        layout, program, n = self.layout, _program(self.layout), len(tables)
        kinds, first, prior = np.empty(n, np.int64), np.empty((n, 7)), np.empty((n, STATE_SIZE))
        same = (
            self._plan, self.dt, stride_of(self.dt), *motion(), program.on_lanes(), self._start,
            (layout.anchors, layout.size, len(program.blank), columns_of(layout).dt),
            _kept(layout), self.time_s,
        )  # fmt: skip

        def arguments(some: slice) -> tuple[Any, ...]:
            return *view(some), *same, kinds[some], first[some], prior[some], tables[some]

        draw = simulate.choice(n * self.epochs, *arguments(parts[0]))
        share(lambda some: draw(*arguments(some)), [(some,) for some in parts], threads)
        first[:, 6] = self.scene.hz_per_mps * (self.radio.prior_bias_mps * first[:, 6])
        prior *= self._prior_deviations
        names = self._names
        return [names[kind] for kind in kinds] if len(names) > 1 else names * n, first + prior

    @cached_property
    def _site(self) -> tuple[Array, list[Any]]:
        """A row of :meth:`Episode.site`, and where in it the mean of the prior belongs."""
        covariance = self.radio.prior_covariance(self.scene)[np.tril_indices(STATE_SIZE)]
        anchors, mean = self.scene.anchors_m.tolist(), [0.0] * STATE_SIZE
        site = Site(anchors, self.scene.hz_per_mps, mean, covariance.tolist())
        return np.array(flatten(site)), indices(site).prior_x

    @cached_property
    def _prior_deviations(self) -> Array:
        return np.sqrt(np.diag(self.radio.prior_covariance(self.scene)))

    @cached_property
    def _users(self) -> tuple[Mobility, ...] | Trajectory:
        if isinstance(self.scenario, Trajectory):
            return self.scenario
        if not isinstance(self.scenario, Mobility) and str(self.scenario).endswith(".csv"):
            return read_trajectory(self.scenario)
        return mobilities_of(self.scenario)

    @property
    def trajectory(self) -> Trajectory | None:
        """The way that is simulated; None where users are drawn."""
        return self._users if isinstance(self._users, Trajectory) else None

    @cached_property
    def _names(self) -> list[str]:
        users = self._users
        return [users.name] if isinstance(users, Trajectory) else [user.name for user in users]

    @cached_property
    def _plan(self) -> TravelPlan:
        users = self._users
        if isinstance(users, Trajectory):
            return users.plan(self.scene, self.dt)
        self.scene.require_streets_in_front()
        return plan_of(users, self.scene.streets)

    @cached_property
    def _start(self) -> Array:
        """The workspace (size,) of an episode before its first epoch."""
        radio, scene = self.radio, self.scene
        constants = EpisodeConstants(
            anchors=scene.anchors_m.tolist(),
            hz_per_mps=scene.hz_per_mps,
            channel=channel_of(radio, scene, self.layout, self.dt),
            first_bias_mps=radio.prior_bias_mps,
            drift_mps=radio.drift_mps * self.dt**0.5,
        )
        return np.array(
            flatten(_program(self.layout).template._replace(constants=constants)), float
        )
