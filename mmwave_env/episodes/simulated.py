"""Simulated episodes: a user in the streets, seen through a channel.

All randomness of an episode is drawn first, in one go and from the episode's own generator.
What follows is arithmetic: functions of numbers that run on lanes, an episode to a lane.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mmwave_env.compiler.rng import RngView, Words, load_state, rng_view, save_state, whole_rng
from mmwave_env.compiler.threads import portions, share
from mmwave_env.episodes.drawing import simulate
from mmwave_env.episodes.episode import Episode, EpisodeBatch, columns_of
from mmwave_env.episodes.kinematics import motion
from mmwave_env.episodes.mobility import MIXED, Mobility, mobilities_of, nets_of, plan_of
from mmwave_env.episodes.simulation import EpisodeConstants, kept_rows, program_of
from mmwave_env.episodes.trajectory import Trajectory, read_trajectory
from mmwave_env.episodes.travel import StreetNets, TravelPlan, stride_of
from mmwave_env.models.channel import channel_of
from mmwave_env.models.epoch import Site
from mmwave_env.models.measurement import STATE_SIZE, Layout
from mmwave_env.models.radio import Radio
from mmwave_env.models.random_scene import RandomScene
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.arrays import Array
from mmwave_env.numerics.pytree import flatten, indices

Scenario = str | os.PathLike[str] | Mobility | Trajectory

CHUNK = 64  # episodes a thread draws at once, at most


@dataclass(frozen=True)
class SimulatedSource:
    """Episodes of simulated users in a street scene.

    Attributes:
        scene: geometry and carrier; or where each episode draws its own from.
        radio: noise, blockage, multipath.
        scenario: kind of user: a name, "mixed", a JSON file or a Mobility; or the way of one: a CSV
            file or a Trajectory.
        dt: seconds between epochs.
        epochs: length of an episode; at most, of a trajectory: a window that is drawn, or all of
            one that is shorter.
        odometry: whether the user also reports speed and heading.
    """

    scene: Scene | RandomScene
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
        return Layout(len(self._example.anchors_m), self.odometry)

    @cached_property
    def _example(self) -> Scene:
        """The scene, or one of those that are drawn: carrier and number of anchors are as here."""
        return self.scene.example if isinstance(self.scene, RandomScene) else self.scene

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
        tables = np.empty((1, self.epochs, len(kept_rows(self.layout))))
        scenes = self._scenes(whole_rng(rng), 1)
        names, priors = self._fill(tables, scenes, lambda _: whole_rng(rng), [slice(None)])
        at = columns_of(self.layout)

        def columns(of: Any) -> Array:
            return np.ascontiguousarray(tables[0][:, of])

        signed_sigma = columns(at.signed_sigma)
        starts = [group.start for group in self.layout.groups]
        return Episode(
            name=names[0],
            scene_anchors_m=scenes[0].anchors_m,
            hz_per_mps=self._example.hz_per_mps,
            time_s=self.time_s,
            measurement=columns(at.z),
            sigma=np.abs(signed_sigma),
            visible=signed_sigma[:, starts] > 0.0,
            snr_db=columns(at.snr_db),
            doppler_spread_hz=columns(at.doppler_spread_hz),
            prior_mean=priors[0],
            prior_covariance=self.radio.prior_covariance(self._example),
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
        shape = (n, self.epochs, len(kept_rows(self.layout)))
        table = np.empty(shape) if out is None else out
        if table.shape != shape or not table.flags.c_contiguous:
            raise ValueError(
                f"out: found shape {table.shape}, contiguous {table.flags.c_contiguous}, expected "
                f"{shape}, contiguous True"
            )
        parts = portions(n, threads, CHUNK)
        scenes = self._scenes(rng_view(states), n)
        names, priors = self._fill(
            table, scenes, lambda some: rng_view(states[some]), parts, threads
        )
        site, at = self._site
        sites = np.empty((n, len(site)))
        sites[:], sites[:, at.prior_x] = site, priors
        sites[:, flatten(at.anchors)] = [scene.anchors_m.ravel() for scene in scenes]
        return EpisodeBatch(
            names=names,
            nonfinite=np.zeros(n, np.int64),
            length=np.full(n, self.epochs),
            table=table,
            site=sites,
            layout=self.layout,
        )

    def _scenes(self, view: RngView, n: int) -> list[Scene]:
        """The scenes of n episodes, each drawn before the rest of its episode; or one for all."""
        if not isinstance(self.scene, RandomScene):
            return [self.scene]
        scenes = []
        for episode in range(n):
            scenes.append(self.scene.draw(load_state(view, episode)))
            save_state(view, episode)
        return scenes

    def _fill(
        self,
        tables: Array,
        scenes: Sequence[Scene],
        view: Callable[[slice], RngView],
        parts: Sequence[slice],
        threads: int = 1,
    ) -> tuple[list[str], Array]:
        """Fill tables (n, epochs, columns); the names, and the means (n, 7) of the priors.

        Before the threads begin, motion and program are compiled, and it is chosen for all of
        them whether the drawing is: else some would repeat, or wait for, what others compile.

        Args:
            tables: to fill.
            scenes: one for all, or one for each.
            view: gives a thread what to draw a part from.
            parts: of the tables, each drawn by one thread.
            threads: how many may draw at once.
        """
        layout, program, n = self.layout, program_of(self.layout), len(tables)
        kinds, first, prior = np.empty(n, np.int64), np.empty((n, 7)), np.empty((n, STATE_SIZE))
        nets, start, one = self._nets(scenes), self._start(scenes), len(scenes) == 1
        same = (
            (layout.anchors, layout.size, len(program.blank), columns_of(layout).dt),
            kept_rows(layout), self.time_s,
        )  # fmt: skip

        def arguments(some: slice) -> tuple[Any, ...]:
            here = slice(None) if one else some
            return (
                *view(some), self._plan, StreetNets(*(numbers[here] for numbers in nets)), self.dt,
                stride_of(self.dt), *motion(), program.on_lanes(), start[here], *same,
                kinds[some], first[some], prior[some], tables[some],
            )  # fmt: skip

        draw = simulate.choice(n * self.epochs, *arguments(parts[0]))
        share(lambda some: draw(*arguments(some)), [(some,) for some in parts], threads)
        first[:, 6] = self._example.hz_per_mps * (self.radio.prior_bias_mps * first[:, 6])
        prior *= self._prior_deviations
        names = self._names
        return [names[kind] for kind in kinds] if len(names) > 1 else names * n, first + prior

    @cached_property
    def _site(self) -> tuple[Array, Any]:
        """A row of :meth:`Episode.site` of the example, and what is where in it."""
        scene = self._example
        covariance = self.radio.prior_covariance(scene)[np.tril_indices(STATE_SIZE)]
        site = Site(
            scene.anchors_m.tolist(), scene.hz_per_mps, [0.0] * STATE_SIZE, covariance.tolist()
        )
        return np.array(flatten(site)), indices(site)

    @cached_property
    def _prior_deviations(self) -> Array:
        return np.sqrt(np.diag(self.radio.prior_covariance(self._example)))

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
        users, scene = self._users, self.scene
        if isinstance(scene, RandomScene):
            if isinstance(users, Trajectory):
                raise ValueError(
                    f"scene: found {scene.name!r}, expected one scene: {users.name} is a way in "
                    "streets of its own"
                )
            return plan_of(users, scene.block_m[0])
        if isinstance(users, Trajectory):
            return users.plan(scene, self.dt)
        scene.require_streets_in_front()
        return plan_of(users, scene.streets.block_m)

    def _nets(self, scenes: Sequence[Scene]) -> StreetNets:
        """The streets of scenes, in numbers."""
        users = () if isinstance(self._users, Trajectory) else self._users
        return nets_of(users, [scene.streets for scene in scenes])

    def _start(self, scenes: Sequence[Scene]) -> Array:
        """Workspaces (scenes, size) of an episode before its first epoch."""
        program, rows = program_of(self.layout), np.tile(self._blank_start, (len(scenes), 1))
        rows[:, flatten(program.index.constants.anchors)] = [
            scene.anchors_m.ravel() for scene in scenes
        ]
        return rows

    @cached_property
    def _blank_start(self) -> Array:
        """The workspace (size,) of an episode of the example before its first epoch."""
        radio, scene = self.radio, self._example
        constants = EpisodeConstants(
            anchors=scene.anchors_m.tolist(),
            hz_per_mps=scene.hz_per_mps,
            channel=channel_of(radio, scene, self.layout, self.dt),
            first_bias_mps=radio.prior_bias_mps,
            drift_mps=radio.drift_mps * self.dt**0.5,
        )
        return np.array(
            flatten(program_of(self.layout).template._replace(constants=constants)), float
        )
