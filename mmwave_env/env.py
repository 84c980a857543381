"""The environment: ``gymnasium.make("MmWaveLoc-v0")``."""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import InvalidAction, ResetNeeded
from numpy.typing import NDArray

from mmwave_env.engines.baseline import baseline_of
from mmwave_env.engines.copies import Copied
from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.replay import Replay
from mmwave_env.engines.tally import Tally, count
from mmwave_env.filters.mode_files import default_modes, modes_from
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.info import (
    FLAGS,
    INFOS,
    NONFINITE_KEY,
    STATE_KEYS,
    drawn_rows,
    episode_info,
    fixed_info,
    smoothed_info,
    told_rows,
    warn_of_nonfinite,
)
from mmwave_env.lookup import choose, require_extra
from mmwave_env.metrics import DIVERGENCE_M
from mmwave_env.models.radio import RADIOS, radio_from
from mmwave_env.models.scene import scene_from
from mmwave_env.observation import Observation
from mmwave_env.rendering.frames import FRAMES_PER_SECOND, SMALLEST, require_drawable
from mmwave_env.rendering.history import Recorder
from mmwave_env.task import task_from
from mmwave_env.world.keys import draw_key, key_from, keys_at, option_of, stream_of
from mmwave_env.world.simulated import SimulatedSource

_INTEGERS = (int, np.int64)  # that actions usually are
_HERE = np.zeros(1, np.int64)  # the place of the environment in a batch of one
BACKENDS = {"lanes": "SIMD lanes", "filterpy": "filterpy's filters, slow, independent"}


class MmWaveLocEnv(Copied, gym.Env[NDArray[np.float32], np.int64]):
    """An agent chooses which Kalman filter pipeline localizes a mobile user.

    ## Description

    A pedestrian or a vehicle moves through a street with three 28 GHz anchors: a base station
    (gNB) and its mirror images in two building walls. Every epoch (1 s) brings, per anchor,
    time of arrival, azimuth and elevation of arrival and azimuth of departure, and one Doppler
    shift. The agent chooses which Kalman filter pipeline, or *mode*, processes the epoch.
    What it chooses changes the estimate, never the world.

    Source: "Mobility-Aware Localization in mmWave Channel: Adaptive Hybrid Filtering Approach",
    whose rule is the EKF up to 2 m/s and the UKF above.

    ## Action Space

    `Discrete(len(modes))`: the mode that processes the current epoch. By default

    {modes}

    as `mmwave-loc tune` left them for the three radios; the noise is per epoch of 1 s. Both gate
    each anchor and the Doppler at the 99 % chi-square quantile, recover from lock-out after two
    epochs, and scale Q and R by the windowed mean of NIS.

    ## Observation Space

    `Box(float32)` of the features below: what the estimator knows, never the truth. It already
    shows the next epoch's measurement as each mode would see it; `observation="prior"` leaves
    those last features ("coming ...", "preference ...") out. A feature is shown as
    (value - mean) / deviation, with the constants below: medians over all streets and radios.
    What is rare is shown at most ten deviations from the mean; `low` and `high` are the bounds of
    what is shown. `env.unwrapped.observation.read(observation, name)` is a value in its own unit,
    within these bounds. With the default arguments:

    {table}

    ## Beliefs per Mode

    By default the modes share one belief, which the mode chosen updates. With `beliefs="per-mode"`
    each keeps its own, and they interact as in an IMM (Blom and Bar-Shalom 1988):

    * Action space: `Discrete(len(modes) + 1)`. Action 0 trusts no mode: the weights are those of
      the likelihoods, and taking it throughout is the IMM itself. Action k multiplies the
      probability of the k-th mode by e^3 over a second before the beliefs are combined and mixed
      again, and its `cost` is subtracted. `mode` of the information is the action.
    * Observation space: as above without distances and the previous mode; the log-odds of every
      mode before and after the coming measurement, its speed and velocity variance, and further
      averages of the Doppler spread come on top. `env.unwrapped.observation.table()` shows it.
    * Information: `mode_probabilities`, after the action; estimate, NEES and reward are of the
      beliefs combined, what gates tell (`nis`, `accepted`, `rejected`, `gamma`) of the most
      probable mode. `reward="paired"` subtracts what action 0 throughout would earn.
    * `modes=None` is the bank of the strongest IMM of the radio,
      `mmwave_env.filters.bank.best_bank`. A mode file may say "transition" (probabilities over a
      second) and "nis_quantile", too.

    ## Rewards

    `reward="tracking"` (default): -(1.0 min(error, 10 m) + 0.2 min(|ln(NEES / 3)|, 3)), with
    the position error and the position's NEES after the epoch. `reward="log-score"`: log
    density of the true position, at least -30. Any function of (belief, truth) works too, see
    `mmwave_env.reward`. A mode's `cost` is subtracted in every epoch that runs it.

    `reward="paired"`: the tracking reward minus that of an IMM over the radio's two default modes,
    in the same epoch of the same episode. Nothing an agent does changes what the IMM earns, so
    the best policy is the same, and training sees less noise: above 0 the agent beats the IMM.
    Other rewards are paired by `mmwave_env.reward.PairedReward(...)`.

    ## Starting State

    An episode is drawn from the scenario: trajectory, channel, measurements, and a prior
    belief around the true state (4 m handset, 3 m standard, 2 m high in each horizontal axis).
    `reset(seed=s)` gives the same episode everywhere.

    ## Episode End

    Truncation after `episode_steps` epochs (default 200, of a trajectory at most; recordings and
    logs: all of them). With `terminate_on_divergence=True` an episode terminates when the error
    exceeds 50 m, and that step pays the worst reward for every epoch left, so that failing fast
    does not pay. A paired reward then also loses what the IMM earns in those epochs: its sum over
    an episode is always the agent's minus the IMM's.

    ## Information

    Every step: `position_error_m`, `nees`, `nis`, `accepted`, `rejected` (per anchor, then
    Doppler), `mode`, `gamma`, `truth` (position, velocity), `estimate` (position, velocity,
    bias); with beliefs per mode also `mode_probabilities`. `reset`: `episode_name`, `episode_key`
    (of simulated episodes), `nonfinite` (links, Doppler shifts and odometry with a NaN or infinity,
    which count as missing), `truth`, `estimate`. The last step adds `ate_m`, `rmse_m`, `rpe_m`,
    `mean_nees`, `in_bounds`, `divergence` (without the first 10 epochs), and with `smoothed=True`
    also `smoothed_ate_m` (Rauch-Tung-Striebel over the episode, which is run again for it). Where
    a belief was NaN or infinite, it warns and tells `nonfinite_beliefs`: after how many epochs.
    `infos="episode"` tells of resets and last steps alone, `infos="none"` nothing: for trainers
    that look at neither. `infos="fixed"` has the same keys at every reset and step, for what asks
    for that (docs/clients.md): numbers only, so without `episode_name` and `episode_key`; what
    there is not to tell is NaN, False or -1.

    ## Keys

    A simulated episode is a function of its key, 64 bits that follow from the environment's seed
    and the number of episodes begun since. `reset(options={"episode_key": key})` plays that
    episode again, in this environment or any other with the same scenario, scene, radio and
    steps. The user goes the same way with another radio, too.

    ## Copies

    `copy.deepcopy` and `pickle` copy an environment in the middle of an episode; the copy goes on
    to the last bit, as planners need it. A deep copy shares the source of episodes and compiled
    code. Vector environments are copied alike; their `state` and `restore` do it by plain arrays.

    ## Arguments

    * `scenario`: "pedestrian", "vehicle", "walk-ride", "jam", "cyclist" or "mixed" (default); a
      JSON file or a `Mobility` for a kind of user of your own; or a CSV file of ways (columns t, x,
      y, z, and id where they are those of several users), a `Trajectory` or `Ways`, of which
      `episode_steps` epochs at most are drawn (docs/own-world.md).
    * `radio`: "handset" (default), "standard", "high", a JSON file, or a `Radio`. Default modes are
      tuned for these three names; others get those of their `base` and a warning.
    * `scene`: "street" (default), "o1", "dynamic-doppler", a JSON file, or a `Scene`; "random" or
      a `RandomScene`, and each episode draws streets, base station and walls of its own.
    * `modes`: list of modes, each a name ("ekf", "ukf", "ckf", "ekf-robust", "ukf-robust"), a
      mode file or a `Mode`, whose algorithm may be your own function (docs/own-filters.md); or
      one mode file, as `mmwave-loc tune` writes it, or a dict of what such a file holds; or a
      `Bank`.
    * `beliefs`: "shared" (default) or "per-mode", see Beliefs per Mode.
    * `reward`: "tracking", "log-score", "paired", a function or a `PairedReward`.
    * `observation`: "full" or "prior".
    * `infos`: "all" (default), "episode", "none" or "fixed", see Information.
    * `smoothed`: whether the last step tells `smoothed_ate_m`; False by default.
    * `episode_steps`, `dt`: epochs per episode and seconds per epoch.
    * `episodes`: recorded data instead of a simulation: a recording that comes along, such as
      "canyon28_vehicle" (`mmwave-loc list samples`), the folder of a DeepMIMO scenario or of a
      measurement log with its scene and truth, a `Recording`, a `MeasuredTrack`
      (docs/own-log.md), or any episode source (whose `radio`, if it has one, then selects the
      default modes' tuning).
    * `planar`: flat terrain: z and vz are known.
    * `odometry`: the user also measures speed and heading.
    * `terminate_on_divergence`: see Episode End.
    * `render_mode`: "rgb_array" or "human", a window in which `h` lists the keys; needs the extra
      `render`.
    * `render_size`, `render_theme`: height and width of pictures, 480 (default) to 1080; "light"
      (default) or "dark".
    * `backend`: "lanes", or "filterpy" for the same modes on filterpy's filters (slow; needs the
      extra `filterpy`).
    * `env_config`: by position, all of these in one mapping, as RLlib hands them to the class.

    ```python
    >>> import gymnasium as gym
    >>> env = gym.make("mmwave_env:MmWaveLoc-v0", scenario="vehicle")
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(1)

    ```

    ## Vectorized environment

    `gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=1024)` steps all environments in one call
    of a compiled kernel; environment i is a single one seeded alike, to the last bit. Further
    arguments: `autoreset_mode` ("NextStep", the default, "SameStep" or "Disabled", a string)
    and `threads`. `step(actions, out=(observations, rewards, terminated, truncated))` fills arrays
    of yours. `render_mode="rgb_array"` draws the first few environments. "human", `infos="fixed"`
    and `backend="filterpy"` need `vectorization_mode="sync"`.

    ## Version History

    * v0: initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own declaration
        "render_modes": ["human", "rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }
    _spec: EnvSpec | None = None

    def __init__(
        self,
        env_config: Mapping[str, Any] | None = None,
        /,
        *,
        observation: str = "full",
        infos: str = "all",
        smoothed: bool = False,
        backend: str = "lanes",
        render_mode: str | None = None,
        render_size: int = SMALLEST,
        render_theme: str = "light",
        **arguments: Any,
    ) -> None:
        if env_config:  # RLlib hands a class all arguments in one
            self.__init__(**env_config)  # type: ignore[misc]
            return
        if render_mode is not None:
            choose(dict.fromkeys(self.metadata["render_modes"]), render_mode, "render_mode")
            require_drawable(render_size, render_theme, f"render_mode={render_mode!r}")
            if render_mode == "human":
                from mmwave_env.rendering.window import require_display

                require_display()
        choose(BACKENDS, backend, "backend")
        choose(INFOS, infos, "infos")
        self.render_mode, self._backend, self._infos = render_mode, backend, infos
        self._observation_kind, self._task = observation, task_from(**arguments)
        self._smoothing = smoothed
        self._drawing = render_size, render_theme
        self._tally = Tally(1, len(self._task.pipeline.position_axes))
        self._interval = self._tally.interval.tolist()
        self._begun, self._over = False, True
        self._steps, self._length = 0, 0
        self._sums, self._errors, self._second = [0.0], [[0.0]], 1
        self._actions = np.empty(0, np.int64)
        self._stream = np.zeros(2, np.uint64)  # as Streams.states
        self._stream_from: np.random.Generator | None = None
        self._set_up_noting()
        rows = drawn_rows(self._engine.at, self._engine.span)
        axes = len(self._task.pipeline.position_axes)
        self._recorder = Recorder(rows, axes) if render_mode else None
        self.observation_space = cast(Any, self.observation.space)
        self.action_space = spaces.Discrete(len(self.observation.actions))

    def _set_up(self) -> None:
        """Make what follows from the arguments; copies do the same."""
        self._picture: Any = None
        self._window: Any = None
        task, on_floats = self._task, self._backend == "filterpy"
        self.source, self.radio, self.reward = task.source, task.radio, task.reward
        pipeline = task.pipeline
        if on_floats:
            require_extra("filterpy", "filterpy", 'backend="filterpy"')
            from mmwave_env.filters.filterpy_reference import filterpy_pipeline

            pipeline = filterpy_pipeline(pipeline)
        self._engine = Engine(
            pipeline, 1, self.reward, self._observation_kind, task.bank, on_floats
        )
        self._replay = Replay(pipeline, task.bank, on_floats) if self._smoothing else None
        self._baseline = baseline_of(task, self._engine.batch)
        self.modes, self.observation = pipeline.modes, self._engine.observation
        at, span = self._engine.at, self._engine.span
        self._io = self._engine.io()
        self._observed, self._error = span(at.observation), span(at.error)
        self._told = {
            key: part if isinstance(part, int) else span(part)
            for key, part in told_rows(at).items()
        }

    @property  # type: ignore[override]
    def spec(self) -> EnvSpec | None:
        """As registered, with the length of the episodes, which wrappers ask for."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        epochs = getattr(self.source, "epochs", None)
        self._spec = spec and replace(spec, max_episode_steps=epochs)
        # `gym.make` ends episodes from outside, whose last step then tells no metrics. It says so
        # nowhere but in a variable of its own.
        make = sys._getframe(1).f_locals
        limit = make.get("max_episode_steps") or getattr(
            make.get("env_spec"), "max_episode_steps", None
        )
        if epochs is not None and limit is not None and 0 < limit < epochs:
            raise ValueError(
                f"max_episode_steps: found {limit}, expected None or {epochs}; episode_steps= "
                "makes episodes of another length, which tell their metrics"
            )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Draw an episode; the same seed gives the same one. See Gymnasium's `Env.reset`.

        ``options={"episode_key": k}`` plays the episode of a key instead, as infos tell it.
        """
        key = option_of(options, "episode_key")
        if key is not None:
            self._task.require_keys(seed)
            key = key_from(key)
        super().reset(seed=seed, options=options)
        info = self._begin(key)
        task, length = self._task, int(self._engine.batch.state.length[0])
        if self._baseline:
            self._baseline.begin(_HERE, partial(self._engine.episodes, task))
        self._begun, self._over, self._steps, self._length = True, False, 0, length
        self._tally.begin(_HERE, self._engine.steps_s(_HERE), np.array([length]))
        self._sums, self._second = self._tally.sums[0].tolist(), int(self._tally.second[0])
        self._errors = self._tally.errors[0].tolist()
        self._actions = np.zeros(length, np.int64)
        column = self._engine.column(0)
        if self._recorder:
            streets = self._task.streets_of(int(self._engine.keys[0]))
            self._recorder.begin(info["episode_name"], streets, column)
            if self.render_mode == "human":
                self.render()
        info |= {key: column[self._told[key]] for key in STATE_KEYS}
        return column[self._observed].astype(np.float32), self._worded(info, begins=True)

    def _begin(self, key: int | None) -> dict[str, Any]:
        """Begin the episode of a key, or the next one; what is told of it."""
        task, engine = self._task, self._engine
        if not task.has_keys:
            episode = task.draw(self.np_random)
            engine.reset([episode])
            return {"episode_name": episode.name, "nonfinite": episode.nonfinite}
        key = self._next_key() if key is None else key
        (name,) = engine.begin(task, np.array([key], np.uint64), _HERE)
        engine.batch.advance()
        return {"episode_name": name, "episode_key": np.uint64(key), "nonfinite": 0}

    def _next_key(self) -> int:
        """The key of the next episode in the stream of the environment's seed."""
        rng, seed = self.np_random, self.np_random_seed
        if rng is not self._stream_from:  # seeded anew, or somebody's own, whose seed is -1
            self._stream_from = rng
            self._stream[:] = draw_key(rng) if seed == -1 else stream_of(seed), 0
        (key,) = keys_at(*self._stream)
        self._stream[1] += np.uint64(1)
        return int(key)

    def step(
        self, action: np.int64
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Process the epoch with a mode, or trust one. See Gymnasium's `Env.step`."""
        if self._over:
            raise ResetNeeded("Call reset before step: there is no episode under way.")
        # Gymnasium's own check takes longer than the filters
        known = type(action) in _INTEGERS and 0 <= action < len(self.observation.actions)
        if not (known or self.action_space.contains(action)):
            raise InvalidAction(
                f"action: found {action!r} ({type(action)}), expected an integer in "
                f"{self.action_space}"
            )
        self._io.inputs[0, 0, 0] = action
        self._engine.batch.advance(self._io)
        column = self._engine.column(0)
        info = self._step_info(column, int(action))
        rewards, distance = np.array([column[self._engine.at.reward]]), info["position_error_m"]
        if self._baseline:
            self._baseline.subtract(rewards, _HERE)
        count(
            self._sums, self._errors, self._second, self._interval, self._steps,
            *column[self._error].tolist(), info["nees"],
        )  # fmt: skip
        self._actions[self._steps] = action
        self._steps += 1
        terminated = False
        if self._task.worst is not None and not distance <= DIVERGENCE_M:
            terminated = True
            rewards += self._task.worst * (self._length - self._steps)
            if self._baseline:
                rewards -= self._baseline.rest(_HERE)
        truncated = not terminated and self._steps == self._length
        if terminated or truncated:
            self._over = True
            info |= self._episode_info()
        if self._recorder:
            self._recorder.add(column, int(action))
            if self.render_mode == "human":
                self.render()
        worded = self._worded(info, ends=self._over)
        observation = self._io.observations[0, 0].copy()
        return observation, float(rewards[0]), terminated, truncated, worded

    def render(self) -> NDArray[np.uint8] | None:
        """The epochs so far, from above: (480, 480, 3) for "rgb_array", or of another size."""
        if self._recorder is None:
            return None
        if not self._begun:
            raise ResetNeeded("Call reset before render: there is no episode under way.")
        size, theme = self._drawing
        if self._picture is None:
            from mmwave_env.rendering.picture import Picture

            self._picture = Picture(self.observation.actions, size, theme)
        picture: NDArray[np.uint8] = self._picture.draw(self._recorder.history)
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            from mmwave_env.rendering.window import Window

            self._window = Window(size, size)
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _step_info(self, column: NDArray[np.float64], mode: int) -> dict[str, Any]:
        """What a step tells, from the workspace (size,) after it."""
        info: dict[str, Any] = {}
        for key, rows in self._told.items():
            value = column[rows]
            info[key] = float(value) if isinstance(rows, int) else value
        return info | {key: info[key] > 0.5 for key in FLAGS} | {"mode": mode}

    def _worded(
        self, info: dict[str, Any], begins: bool = False, ends: bool = False
    ) -> dict[str, Any]:
        """An info as ``infos`` asks for it."""
        if self._infos == "none" or (self._infos == "episode" and not (begins or ends)):
            return {}
        if self._infos != "fixed":
            return info
        groups = len(self._task.pipeline.layout.groups)
        beliefs = len(self.modes) if self._task.bank else 1
        return fixed_info(info, groups, beliefs)

    def _episode_info(self) -> dict[str, Any]:
        """Metrics of the epochs stepped through, and how many ended without a finite belief."""
        self._tally.sums[0] = self._sums
        found = episode_info(self._tally.metrics(_HERE, np.array([self._steps])))
        if self._replay:
            episodes = self._engine.episodes(self._task, _HERE)
            *_, errors = self._replay.run(episodes, self._actions[None, : self._steps])
            found |= smoothed_info(errors)
        told: dict[str, Any] = {key: float(value[0]) for key, value in found.items()}
        (lost,) = self._tally.nonfinite(_HERE).tolist()
        if lost:
            warn_of_nonfinite()
            told[NONFINITE_KEY] = lost
        return told


def _with_tables(docstring: str) -> str:
    """The docstring with the modes and the observation of the default environment in it."""
    source = SimulatedSource(scene_from("street"), radio_from("handset"))
    observed = Observation(Pipeline(modes_from(None), source.layout)).table()
    return inspect.cleandoc(docstring).replace("{table}", observed).replace("{modes}", _modes())


def _modes() -> str:
    """The default modes as a table, with what was tuned for each radio."""
    lines = ["| action | mode | algorithm | horizontal velocity noise, m/s |", "|---|---|---|---|"]
    for action, (kind, algorithm) in enumerate(
        (("low mobility", "EKF"), ("high mobility", "UKF (alpha 1, beta 2, kappa 0)"))
    ):
        tuned = (f"{default_modes(radio)[action].sigma_v:.2f} {radio}" for radio in RADIOS)
        lines.append(f"| {action} | {kind} | {algorithm} | {', '.join(tuned)} |")
    return "\n".join(lines)


if MmWaveLocEnv.__doc__ is not None:  # python -OO drops docstrings
    MmWaveLocEnv.__doc__ = _with_tables(MmWaveLocEnv.__doc__)
