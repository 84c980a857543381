"""Simulated episodes of a user in the streets, observed through a radio channel.

An episode is a function of its key, an integer of 64 bits. The key determines the beginning; the
simulation continues from there, epoch by epoch. Eight SIMD lanes simulate eight episodes at once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import BatchState, Feed, Program, StepIO, blocks_of, fill, rows_of
from mmwave_env.models.envelope import STEP_S
from mmwave_env.models.layout import Layout, offered_rows
from mmwave_env.models.motion import CLOCK_SIGMA_M, FREE_BIAS_M
from mmwave_env.models.radio import SNR_LIMITS_DB, Radio
from mmwave_env.models.random_scene import RandomScene, RandomSurvey
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array
from mmwave_env.numerics.pytree import flatten
from mmwave_env.numerics.random import Dice, seeded
from mmwave_env.world.channel import channel_of
from mmwave_env.world.episode import Episode, EpisodeBatch, Incoming, columns_of, site_index
from mmwave_env.world.keys import Keys, draw_key
from mmwave_env.world.mobility import FASTEST_MPS, MIXED, plans_of
from mmwave_env.world.simulation import (
    USER,
    StartState,
    World,
    WorldSettings,
    as_measured,
    on_a_way,
    start_program,
    world_of,
)
from mmwave_env.world.trajectory import PlacedWays, Scenario, Users, users_of
from mmwave_env.world.travel import TravelPlan, stride_of

RARE = 4.0  # number of standard deviations that only rare events exceed
MOST_EPOCHS = 1_000_000  # maximum per episode, as times and actions of all epochs are stored


class EpisodeStarts(NamedTuple):
    """The beginnings of n episodes, whose users are simulated or follow given ways (trajectories).

    Attributes:
        names: (n,) names of the kinds of users, or of the given ways.
        worlds: (n, numbers) state of receiver and user before the first epoch; if ways are given,
            only the state of the receiver.
        truth: (n, epochs, 6) true positions and velocities on given ways; else (n, epochs, 0).
        sites: (n, numbers) anchors, carrier and prior, each row as :meth:`Episode.site` returns it.
    """

    names: list[str]
    worlds: Array
    truth: Array
    sites: Array


@dataclass(frozen=True)
class SimulatedSource:
    """A source of episodes of simulated users in a street scene.

    Attributes:
        scene: the scene of all episodes, or a random scene from which each episode draws its own.
        radio: radio profile, which determines noise, blockage and multipath.
        scenario: kind of user (a name, "mixed", a JSON file or a Mobility), or given ways (a
            Trajectory or Ways).
        dt: seconds between epochs.
        epochs: length of an episode. With given ways, an episode is a random window of one of them;
            if all ways are shorter than ``epochs``, episodes are as long as the longest way.
        odometry: whether the user also reports speed and heading.
        measurements: names of the quantities that the receiver measures, some of
            :data:`~mmwave_env.models.layout.MEASUREMENTS`; None for all.
        clock: state of the user's clock, one of :data:`~mmwave_env.models.layout.CLOCKS`.
        survey: distribution of survey errors; None if the survey is exact.
    """

    scene: Scene | RandomScene
    radio: Radio
    scenario: Scenario = "mixed"
    dt: float = 1.0
    epochs: int = 200
    odometry: bool = False
    measurements: tuple[str, ...] | None = None
    clock: str = "synchronized"
    survey: RandomSurvey | None = None

    def __post_init__(self) -> None:
        if not STEP_S.holds(self.dt):
            raise ValueError(f"dt: found {self.dt}, expected {STEP_S.expected}")
        if not 1 <= self.epochs <= MOST_EPOCHS:
            raise ValueError(
                f"episode_steps (epochs): found {self.epochs}, expected 1 to {MOST_EPOCHS}"
            )
        assert self._extreme
        if not self._plans:
            object.__setattr__(self, "epochs", self.ways.epochs)

    @cached_property
    def _extreme(self) -> Episode:
        """Return an example; refuse a radio and a scene whose episodes filters could refuse."""
        scene = self.example
        radio = self.radio
        snr_db = np.repeat(np.array(SNR_LIMITS_DB)[:, None], self.layout.anchors, axis=1)
        rarely = math.exp(RARE * radio.spread_sigma)
        spread_mps = radio.spread_gain * FASTEST_MPS * rarely + RARE * radio.spread_floor_mps
        return Episode.measured(
            scene,
            radio,
            self.layout,
            snr_db,
            name=f"{radio.name} in {scene.name}",
            time_s=np.array([0.0, self.dt]),
            measurement=np.zeros((2, self.layout.size)),
            visible=np.ones((2, len(self.layout.groups)), np.bool_),
            doppler_spread_hz=np.array([0.0, scene.hz_per_mps * spread_mps]),
            prior_mean=np.zeros(self.layout.state_size),
            prior_covariance=self._prior_covariance,
        )

    @cached_property
    def layout(self) -> Layout:
        """Return the layout of every episode's measurements."""
        partial = self.measurements is not None or self.clock == "free"
        return Layout(len(self.example.anchors_m), self.odometry, partial, self.clock)

    @property
    def _prior_covariance(self) -> Array:
        return self.radio.prior_covariance(self.example, self.clock)

    @cached_property
    def example(self) -> Scene:
        """Return the scene; for a random scene, an example with its carrier and anchor count."""
        return self.scene.example if isinstance(self.scene, RandomScene) else self.scene

    @property
    def time_s(self) -> Array:
        """Return the times (epochs,) of every episode."""
        return self.dt * np.arange(self.epochs, dtype=np.float64)

    @property
    def name(self) -> str:
        """Return the scenario's name, followed by the scene's name unless that is "street"."""
        users = self._users
        scene = self.scene.name
        if not isinstance(users, tuple):
            name = users.name
        else:
            name = users[0].name if len(users) == 1 else MIXED
        return name if scene == "street" else f"{name} on {scene}"

    def sample(self, rng: np.random.Generator) -> Episode:
        """Draw one episode; only its key is drawn from ``rng``."""
        return self.episode(draw_key(rng))

    def episode(self, key: int) -> Episode:
        """Return the episode that a key determines."""
        (episode,) = self.episodes(np.array([key], np.uint64))
        return episode

    def episodes(self, keys: Keys) -> list[Episode]:
        """Return the episodes that the keys (n,) determine."""
        batch = self.sample_batch(keys)
        index = site_index(self.layout)
        scene = self.example
        episodes = []
        for name, table, site in zip(batch.names, batch.table, batch.site, strict=True):
            columns = [np.ascontiguousarray(table[:, c]) for c in columns_of(self.layout)]
            rows: Any = Incoming._make(columns)
            measured = rows.signed_sigma > 0.0
            episode = Episode(
                name,
                site[index.anchors],
                scene.hz_per_mps,
                self.time_s,
                np.where(measured, rows.z, np.nan) if self.layout.partial else rows.z,
                np.abs(rows.signed_sigma),
                np.logical_or.reduceat(measured, self.layout.starts, axis=1),
                rows.snr_db,
                rows.doppler_spread_hz,
                site[index.prior_x],
                self._prior_covariance,
                self.layout,
                rows.truth[:, :3],
                rows.truth[:, 3:],
            )
            episodes.append(episode)
        return episodes

    def scene_of(self, key: int) -> Scene:
        """Return the scene of the episode that a key determines."""
        if not isinstance(self.scene, RandomScene):
            return self.scene
        word = float(np.array(key, np.uint64).view(np.float64))
        return self.scene.scene_of(self.scene.draw_numbers(Dice(seeded(word, USER))))

    def sample_batch(self, keys: Keys, threads: int = 1) -> EpisodeBatch:
        """Return the episodes of keys (n,) as a batch, drawn by at most ``threads`` threads."""
        n = len(keys)
        starts = self.begin(keys)
        if self.travels:
            program: Program[Any] = as_measured(self.layout)
            feed = self.feed(n)
            fill(feed.kept, np.arange(starts.worlds.shape[1]), starts.worlds)
            state = BatchState.of(starts.truth, blocks_of(program.start, n))._replace(feed=feed)
        else:
            program = on_a_way(self.layout, self.survey is not None)
            receiver = rows_of(program.index.receiver)
            rows = fill(blocks_of(program.start, n), receiver, starts.worlds)
            rows[:, rows_of(program.index.settings)] = self._settings_rows
            state = BatchState.of(starts.truth, rows)
        io = StepIO.of(n, self.epochs, output_rows=rows_of(program.index.measured))
        program.run_on_lanes(state, io, threads)
        return EpisodeBatch(
            names=starts.names,
            length=np.full(n, self.epochs),
            table=io.outputs,
            site=starts.sites,
            layout=self.layout,
        )

    def feed(self, n: int) -> Feed:
        """Return compiled code that simulates n episodes, with room for their worlds.

        The worlds are placeholders, which :attr:`EpisodeStarts.worlds` must replace.
        """
        _, _, receiver, user = self.world.template
        kept = blocks_of(np.array(flatten([receiver, user]), float), n)
        return Feed(self.world.on_lanes(), self._settings_rows, kept)

    @property
    def travels(self) -> bool:
        """Return whether users are simulated; otherwise they follow given ways from a table."""
        return bool(self._plans)

    def begin(self, keys: Keys) -> EpisodeStarts:
        """Return the beginnings of the episodes of keys (n,)."""
        n = len(keys)
        program = self._start_program
        world = "receiver user" if self.travels else "receiver"
        drawn = ("choice", "first", "prior_noise", "mapped", world)
        io = StepIO.of(n, 1, output_rows=program.rows(drawn))
        tables = keys.view(np.float64).reshape(n, 1, 1)
        program.run_on_lanes(BatchState.of(tables, blocks_of(self._before, n)), io)
        outputs = program.by_name(drawn, io.outputs[:, 0])
        choice, first, noise, anchors, worlds = outputs.values()
        kinds = choice.astype(np.int64)
        truth = np.empty((n, self.epochs, 0))
        if not self.travels:
            kinds, truth = self.ways.draw(choice)
            first[:, :6] = truth[:, 0]
        index = site_index(self.layout)
        sites = np.tile(self._extreme.site(), (n, 1))
        sites[:, index.prior_x] = first + noise
        sites[:, flatten(index.anchors)] = anchors
        names = [self.names[kind] for kind in kinds]
        return EpisodeStarts(names, worlds, truth, sites)

    @cached_property
    def _users(self) -> Users:
        return users_of(self.scenario)

    @cached_property
    def names(self) -> Sequence[str]:
        """Return the names of the kinds of users, or of the given ways."""
        users = self._users
        return [user.name for user in users] if isinstance(users, tuple) else self.ways.names

    @cached_property
    def _plans(self) -> list[TravelPlan]:
        """Return the travel plans of the kinds of users; none if ways are given."""
        users = self._users
        scene = self.scene
        if not isinstance(users, tuple):
            if isinstance(scene, RandomScene):
                raise ValueError(
                    f"scene: found {scene.name!r}, expected a fixed scene, because the trajectory "
                    f"{users.name} does not fit random streets"
                )
            return []
        if isinstance(scene, RandomScene):
            return plans_of(users, scene.block_m[0])
        scene.require_streets_in_front()
        return plans_of(users, scene.streets.block_m)

    @cached_property
    def ways(self) -> PlacedWays:
        """Return the given ways, placed in the scene."""
        users = self._users
        assert not isinstance(users, tuple)
        return users.placed(self.example, self.dt, self.epochs)

    @property
    def world(self) -> World:
        """Return the world that simulates users who are not on given ways."""
        return world_of(self.layout, *self._room, self.survey is not None)

    @property
    def _room(self) -> tuple[int, int]:
        """Return the number of phases in a plan, and of gaits (target speeds) in a phase."""
        phases = [plan.phases for plan in self._plans]
        return (len(phases[0]), len(phases[0][0].phase.gaits)) if phases else (1, 1)

    @property
    def _start_program(self) -> Program[StartState]:
        streets = self.scene if isinstance(self.scene, RandomScene) else None
        return start_program(self.layout, len(self._plans), *self._room, streets, self.survey)

    @cached_property
    def _before(self) -> Array:
        """Return the input (size,) of the program that begins episodes, with 0 as the key."""
        scene = self.example
        radio = self.radio
        filled = self._start_program.template._replace(
            plans=self._plans,
            scene=scene.numbers,
            duration_s=self.epochs * self.dt,
            prior_deviation=np.sqrt(np.diag(self._prior_covariance)).tolist(),
            first_bias_hz=scene.hz_per_mps * radio.prior_bias_mps,
        )
        return np.array(flatten(filled), float)

    @cached_property
    def _settings_rows(self) -> Array:
        """Return the settings (rows, 8 lanes), which are the same in all episodes."""
        radio = self.radio
        scene = self.example
        stride = stride_of(self.dt)
        clocks = {
            "synchronized": (),
            "offset": (1.0, 0.5 * self.dt / scene.hz_per_mps, CLOCK_SIGMA_M * self.dt**0.5),
            "free": (0.0, 0.0, FREE_BIAS_M),
        }
        settings = WorldSettings(
            hz_per_mps=scene.hz_per_mps,
            channel=channel_of(radio, scene, self.layout, self.dt),
            dt=self.dt,
            drift_hz=scene.hz_per_mps * (radio.drift_mps * self.dt**0.5),
            step_s=self.dt / stride,
            stride=float(stride),
            offered=[*map(float, offered_rows(self.layout, self.measurements))]
            if self.layout.partial
            else (),
            clock=clocks[self.clock],
            slow=[math.exp(-self.dt / self.survey.slow_s)] if self.survey else (),
        )
        return np.repeat(np.array(flatten(settings), float)[:, None], WIDTH, axis=1)
