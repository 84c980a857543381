"""The task that the arguments of a single or vectorized ``MmWaveLoc-v0`` define."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

from mmwave_env.datasets.recorded import Track, TrackSource
from mmwave_env.datasets.samples import read_track
from mmwave_env.datasets.ways import scenario_from
from mmwave_env.filters.bank import Bank, Modes, bank_from, modes_from
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.interface.actions import ACTIONS, CORRECTION, MODE
from mmwave_env.interface.observation import BELIEFS, Observation
from mmwave_env.interface.reward import PairedReward, Reward, reward_from
from mmwave_env.io.files import AnyPath
from mmwave_env.io.lookup import choose, did_you_mean
from mmwave_env.io.records import require
from mmwave_env.models.layout import measurements_from, require_clock
from mmwave_env.models.radio import Radio, radio_from
from mmwave_env.models.random_scene import RandomScene, RandomSurvey, scenes_from, survey_from
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.numbers import Array32
from mmwave_env.world.episode import EpisodeSource
from mmwave_env.world.simulated import SimulatedSource
from mmwave_env.world.trajectory import Scenario

EPISODE_STEPS = 200
# function that makes an agent from the description of the observations (which feature is in which
# column); an agent is a function from observations (n, features) to actions (n,)
Base = Callable[[Observation], Callable[[Array32], Any]]


@dataclass(frozen=True)
class Task:
    """A task: the source of episodes, their filters and the reward."""

    source: EpisodeSource
    radio: Radio  # profile of the receiver
    pipeline: Pipeline
    bank: Bank | None  # modes and transition probabilities; None if modes share a belief
    reward: Reward  # function of (belief, truth)
    baseline: Bank | None  # bank of the IMM whose reward is subtracted; None to subtract nothing
    # reward of each epoch that remains after a divergence; None if divergence does not end episodes
    worst: float | None
    action: str  # kind of actions
    # for corrections: makes the agent that chooses modes; None if an IMM weighs the modes
    base: Base | None

    @property
    def has_keys(self) -> bool:
        """Return whether every episode is a function of a key, which is a 64-bit number."""
        return type(self.source) is SimulatedSource  # a subclass may draw episodes without keys

    def scene_of(self, key: int) -> Scene | None:
        """Return the scene that pictures of a key's episode show; None if streets are unknown."""
        if isinstance(self.source, TrackSource):
            scene = self.source.scene
            return scene if scene.streets_known else None
        if not self.has_keys:
            return None
        scene = self.simulated.scene_of(key)
        return scene if self.simulated.travels or scene.streets_known else None

    def require_keys(self, seed: Any) -> None:
        """Refuse a key if episodes have no keys, or if a seed (which determines a key) is given."""
        if not self.has_keys:
            raise ValueError(
                f"options['episode_key']: found a key, but the episodes of {self.source.name!r} "
                "have no keys; only episodes that the package simulates have keys"
            )
        if seed is not None:
            raise ValueError(
                f"options['episode_key'] and seed: found both (seed {seed!r}), expected only one "
                "of them, because a seed also determines the key"
            )

    @property
    def simulated(self) -> SimulatedSource:
        """Return the source as a ``SimulatedSource``; call this only if episodes have keys."""
        return cast(SimulatedSource, self.source)


@dataclass(frozen=True, kw_only=True)
class TaskArguments:
    """The arguments of an environment that define its task, with their defaults.

    :class:`~mmwave_env.env.MmWaveLocEnv` explains the arguments.
    """

    scenario: Scenario | None = None
    radio: AnyPath | Radio = "handset"
    scene: str | Scene | RandomScene | None = None
    modes: Modes = None
    beliefs: str = "shared"
    reward: str | Reward | PairedReward = "tracking"
    episode_steps: int | None = None
    dt: float | None = None
    episodes: AnyPath | Track | EpisodeSource | None = None
    planar: bool = False
    odometry: bool = False
    measurements: Sequence[str] | None = None
    clock: str = "synchronized"
    survey: str | RandomSurvey | None = None
    terminate_on_divergence: bool = False
    action: str = MODE
    base: Base | None = None


def task_from(**arguments: Any) -> Task:
    """Return the task that an environment's arguments define; :class:`TaskArguments` lists them.

    Raises:
        TypeError: an argument is unknown.
        ValueError: an argument is invalid; the message says what is valid.
    """
    known = [field.name for field in fields(TaskArguments)]
    for name in arguments:
        if name not in known:
            raise TypeError(  # some libraries look for these words, as in Python's own message
                f"got an unexpected keyword argument {name!r}, expected one of "
                f"{', '.join(known)}{did_you_mean(name, known)}"
            )
    asked = TaskArguments(**arguments)
    require("episode_steps", asked.episode_steps, int | None)
    require("dt", asked.dt, float | None)
    for name in ("planar", "odometry", "terminate_on_divergence"):
        require(name, getattr(asked, name), bool)
    _require_action(asked)
    radio = radio_from(asked.radio)
    source = _source(asked, radio)
    radio = getattr(source, "radio", radio)
    pays = reward_from(asked.reward)
    bank, modes = bank_and_modes(asked.modes, asked.beliefs, radio)
    pipeline = Pipeline(modes, source.layout, asked.planar)
    baseline = None
    if isinstance(pays, PairedReward):
        baseline = bank or Bank(modes_from(None, radio))
        pays = pays.reward
    worst = None
    if asked.terminate_on_divergence:
        lowest: Any = getattr(pays, "worst", None)
        require("worst", lowest, float, " (reward's attribute for terminate_on_divergence)")
        if baseline and asked.action == CORRECTION:
            raise ValueError(
                "terminate_on_divergence: cannot be combined with corrections and a paired reward"
            )
        worst = lowest - max(mode.cost for mode in pipeline.modes)
    return Task(source, radio, pipeline, bank, pays, baseline, worst, asked.action, asked.base)


def _require_action(asked: TaskArguments) -> None:
    """Refuse an unknown ``action``, and arguments that can't be combined with it."""
    choose(ACTIONS, asked.action, "action")
    if asked.action != MODE and asked.beliefs != "per-mode":
        raise ValueError(f'action: found {asked.action!r}, which needs beliefs="per-mode"')
    if asked.base is not None and not (asked.action == CORRECTION and callable(asked.base)):
        raise ValueError(
            f"base: found {asked.base!r}, expected a function and action={CORRECTION!r}"
        )


def bank_and_modes(
    modes: Modes, beliefs: str, radio: str | Radio
) -> tuple[Bank | None, tuple[Mode, ...]]:
    """Return the bank (None if modes share a belief) and the modes for these arguments.

    ``modes`` and ``beliefs`` are arguments of :class:`~mmwave_env.env.MmWaveLocEnv`. Modes that are
    given by name are tuned for the radio profile.

    Raises:
        ValueError: an argument is invalid; the message says what is valid.
    """
    choose(BELIEFS, beliefs, "beliefs")
    if beliefs == "per-mode":
        bank = bank_from(modes, radio)
        return bank, bank.modes
    if isinstance(modes, Bank):
        raise ValueError(
            "modes: found a bank, expected a list of modes; a bank needs beliefs='per-mode'"
        )
    return None, modes_from(modes, radio)


def _source(asked: TaskArguments, radio: Radio) -> EpisodeSource:
    """Return the source of episodes."""
    measurements = measurements_from(asked.measurements)
    require_clock(asked.clock, measurements)
    if asked.episodes is None:
        simulated = SimulatedSource(
            scenes_from("street" if asked.scene is None else asked.scene),
            radio,
            scenario_from("mixed" if asked.scenario is None else asked.scenario),
            1.0 if asked.dt is None else asked.dt,
            EPISODE_STEPS if asked.episode_steps is None else asked.episode_steps,
            asked.odometry,
            measurements,
            asked.clock,
            survey_from(asked.survey),
        )
        if asked.episode_steps is not None and simulated.epochs < asked.episode_steps:
            raise ValueError(
                f"episode_steps: found {asked.episode_steps}, expected at most {simulated.epochs}, "
                f"the epochs of {simulated.name}"
            )
        return simulated
    episodes: Any = asked.episodes
    if isinstance(episodes, str | os.PathLike):
        episodes = read_track(episodes, asked.clock)
    determined = ["scenario", "scene", "dt", "odometry", "survey"]
    if not isinstance(episodes, Track):
        determined += ["episode_steps", "measurements", "clock"]
        if not hasattr(episodes, "layout") or not hasattr(episodes, "sample"):
            raise ValueError(
                f"episodes: found {episodes!r}, expected a name, a folder, a recording, a measured "
                "track, or a source with layout and sample(rng)"
            )
    for name in determined:
        value = getattr(asked, name)
        if value != getattr(TaskArguments, name):
            raise ValueError(f"{name}: found {value!r}, but the episodes determine this value")
    if isinstance(episodes, Track):
        return TrackSource(episodes, radio, asked.episode_steps, measurements, asked.clock)
    return episodes  # type: ignore[no-any-return]
