"""The environment that ``gymnasium.make("MmWaveLoc-v0")`` makes."""

import sys
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import InvalidAction, ResetNeeded

from mmwave_env.engines.environment import Environment
from mmwave_env.interface.actions import numbers_in, space_of
from mmwave_env.interface.info import NONFINITE_KEY, Info
from mmwave_env.io.lookup import choose
from mmwave_env.numerics.numbers import Array, Array32, Index
from mmwave_env.rendering.gallery import Gallery
from mmwave_env.rendering.theme import FRAMES_PER_SECOND, SMALLEST, Pixels, require_drawable
from mmwave_env.task import task_from
from mmwave_env.world.keys import key_from, options_of

_INTEGERS = (int, np.int64)  # usual types of actions
_HERE = np.zeros(1, np.int64)  # index of the environment in a batch of one
BACKENDS = {"lanes": "SIMD lanes", "filterpy": "the slow, independent filters of filterpy"}


class MmWaveLocEnv(Environment, gym.Env[Array32, Any]):
    """An agent chooses which Kalman filter pipeline localizes a mobile user.

    ## Description

    A pedestrian or a vehicle moves through a street with three 28 GHz anchors: a base station
    (gNB) and its mirror images in two building walls. In every epoch (1 s) the time of arrival,
    the azimuth and elevation of arrival and the azimuth of departure are measured for each anchor;
    one Doppler shift is measured, too. The agent chooses which Kalman filter pipeline, or *mode*,
    processes the epoch. Its choice changes the estimate, never the world.

    Source: "Mobility-Aware Localization in mmWave Channel: Adaptive Hybrid Filtering Approach".
    The paper uses an extended Kalman filter (EKF) up to 2 m/s and an unscented one (UKF) above.

    ## Action Space

    `Discrete(len(modes))`: the mode that processes the current epoch. The default modes are

    | action | mode | algorithm | horizontal velocity noise, m/s |
    |---|---|---|---|
    | 0 | low mobility | EKF | 0.34 handset, 0.40 standard, 0.40 high |
    | 1 | high mobility | UKF (alpha 1, beta 2, kappa 0) | 1.35 handset, 1.31 standard, 1.26 high |

    The noise per epoch of 1 s was tuned by `mmwave-loc tune` for the three radios. Both modes gate
    each anchor and the Doppler shift at the 99 % chi-square quantile, accept all links after two
    successive epochs in which the gates rejected every link, and scale Q and R by the mean NIS.

    ## Observation Space

    `Box(float32)`: what the estimator knows, never the truth. By default 53 features: the predicted
    speed and distances to the anchors; SNRs and the Doppler spread of the coming epoch; NIS, gates
    and corrections of the last epochs; the covariance; and how well each mode would explain the
    coming epoch ("coming ...", "preference ..."), which `observation="prior"` leaves out.

    `print(env.unwrapped.observation.table())` lists all, with their meanings and units. A feature
    is (value - mean) / deviation, with constants for mean and deviation, and at most ten deviations
    from the mean. `env.unwrapped.observation.read(observation, "predicted speed")` returns a
    feature in its own unit.

    ## Beliefs per Mode

    By default the modes share one belief, which the chosen mode updates. With `beliefs="per-mode"`
    each mode keeps its own belief, and the beliefs interact as in an IMM (Blom, Bar-Shalom 1988):

    * Action space: `Discrete(len(modes) + 1)`. Action 0 trusts no mode: an agent that always takes
      it is the IMM itself. Action k multiplies the probability of the k-th mode by e^3 per second;
      then the beliefs are combined and mixed again.
    * Observation space: as above without distances and the previous mode, but with the log-odds of
      each mode before and after the coming measurement, the mode's speed and velocity variance,
      and more averages of the Doppler spread.
    * Information: `mode` is the action; `mode_probabilities` include its effect. Estimate,
      NEES and reward belong to the combined belief; `nis`, `accepted`, `rejected` and `gamma` to
      the most probable mode. `reward="paired"` subtracts the reward of always taking action 0.
    * `modes=None` selects the bank (modes and transition probabilities) of the radio's strongest
      IMM, `mmwave_env.filters.bank.best_bank`. A mode file for a bank may also contain
      "transition" (probabilities over one second) and "nis_quantile".

    ## Actions that are Numbers

    With beliefs per mode, `action` selects another action space. No mode's `cost` is subtracted
    then, and `mode` in infos is 0.

    * `action="weights"`: `Box` (modes,), -3 to 3: logarithms of factors on the probabilities of
      the modes, per second. A weight of 3 for one mode, and 0 for the others, trusts that mode.
    * `action="correction"`: `Box` (6,): shifts of the position along the estimated velocity, across
      it (to the left) and up, -4 to 4 standard deviations of the belief; then logarithms of factors
      on these deviations, -2 to 2. The observation describes an epoch after its update and nothing
      later. The action corrects the belief of that epoch; reward and infos use the result.
      The filters go on without corrections, so actions have no later effect (use a discount of 0);
      `reward="paired"` subtracts the reward of the belief without correction. By default the
      filters are an IMM. With `base`, a second agent, without memory, trusts modes: `base`
      is a function that takes the table of the filters' features and returns the agent, such as
      `partial(LearnedSwitch, "guided")`.

    ## Rewards

    `reward="tracking"` (default): -(1.0 min(error, 10 m) + 0.2 min(|ln(NEES / 3)|, 3)), with
    the position error and the position's NEES after the epoch. `reward="log-score"`: log
    density of the true position, at least -30. Any function of (belief, truth) works too; see
    `mmwave_env.interface.reward`. A mode's `cost` is subtracted whenever the mode is chosen. The
    array `info["reward_terms"]` holds the terms of the epoch's reward, in the order of the names
    `env.unwrapped.reward_terms`; the last term is the cost.

    `reward="paired"`: the tracking reward minus the reward of an IMM over the radio's two default
    modes, in the same epoch of the same episode. The best policy stays the same, and the reward is
    less noisy. `PairedReward` pairs another one.

    ## Starting State

    An episode consists of a trajectory, the channel, measurements, and a prior belief around the
    true state (standard deviation of x and of y: 4 m for the handset radio, 3 m for standard, 2 m
    for high), all drawn from the scenario. `reset(seed=s)` draws the same episode everywhere.

    ## Episode End

    An episode is truncated after `episode_steps` epochs: by default 200, or all epochs of a
    shorter trajectory, of a recording or of a log. With `terminate_on_divergence=True` it
    terminates when the error exceeds 50 m, and the last step earns the worst reward for every
    remaining epoch, so that failing fast does not pay. A paired reward is also reduced by what
    the IMM earns in those epochs.

    ## Information

    * Every step: `position_error_m`, `nees`, `nis`, `accepted`, `rejected` (per anchor, then
      Doppler), `mode`, `gamma`, `truth` (position, velocity), `estimate` (position, velocity,
      bias; with another `clock` also the range bias, m), `reward_terms`, `cost` (for constrained
      learning: 1.0 if the horizontal error is so large that a Gaussian error with the belief's
      covariance exceeds it with a probability below 0.001, else 0.0); with beliefs per mode also
      `mode_probabilities`.
    * `reset`: `episode_name`, `episode_key` (of simulated episodes), `truth`, `estimate`, and
      `nonfinite`: the number of links, Doppler shifts and odometry readings that contain NaN or
      infinity and count as missing.
    * The last step adds `ate_m`, `rmse_m`, `rpe_m`, `mean_nees`, `in_bounds`, `divergence` (all
      without the first 10 epochs). If beliefs were NaN or infinite, there is a warning, and
      `nonfinite_beliefs` counts the epochs with such beliefs.

    ## Keys

    A simulated episode is a function of its key: 64 bits, computed from the seed of the environment
    and the number of the episode. `reset(options={"episode_key": key})` plays the episode again in
    any environment with the same scenario, scene, radio and steps. With another radio the user
    still moves along the same trajectory.

    ## Copies

    `copy.deepcopy` and `pickle` copy an environment in the middle of an episode, for planners; the
    copy continues identically, to the last bit. A deep copy shares its source of episodes with
    the original.

    ## Arguments

    * `scenario`: "pedestrian", "vehicle", "walk-ride", "jam", "cyclist" or "mixed" (default); a
      JSON file or a `Mobility` for your own kind of user; a CSV file of trajectories (columns t, x,
      y, z, and id for several users), a `Trajectory` or `Ways` (docs/own-world.md).
    * `radio`: "handset" (default), "standard", "high", a JSON file, or a `Radio`. Default modes are
      tuned for these three names; other radios use the modes of their `base`, with a warning.
    * `scene`: "street" (default), "o1", "dynamic-doppler", a JSON file, or a `Scene`; with "random"
      or a `RandomScene` each episode draws its own streets, base station and walls.
    * `modes`: list of modes, each a name ("ekf", "ukf", "ckf", "ekf-robust", "ukf-robust"), a
      mode file or a `Mode`, whose algorithm may be your own function (docs/own-filters.md); or
      one mode file, a dict with the content of such a file, or a `Bank`.
    * `beliefs`: "shared" (default) or "per-mode".
    * `action`, `base`: "mode" (default), "weights" or "correction", see Actions that are Numbers.
    * `reward`: "tracking", "log-score", "paired", a function or a `PairedReward`.
    * `observation`: "full", "prior" or "signed", which adds residuals of the last epoch to "full".
    * `episode_steps`, `dt`: epochs per episode and seconds per epoch.
    * `episodes`: recorded data instead of a simulation: a recording of the package, such as
      "canyon28_vehicle" (docs/deepmimo.md), the folder of a DeepMIMO scenario or of a
      measurement log with its scene and truth, a `Recording`, a `MeasuredTrack` (docs/own-log.md),
      or any episode source; if a source has a `radio`, the default modes are those tuned for it.
    * `planar`: whether the terrain is flat, so that z and vz are known.
    * `odometry`: whether the user also measures speed and heading.
    * `measurements`: names of the quantities that the receiver measures, from "range", "azimuth"
      and "elevation" (of arrival), "departure" (azimuth) and "doppler"; None (default) for all.
      "range", "azimuth" or "departure" must be among them. Gates and `nis` then use only these
      quantities. The truth and the remaining values of an episode stay the same.
    * `clock`: "synchronized" (default); "offset": the user's clock has an unknown offset, at first
      with a standard deviation of 100 ns, and the oscillator's bias makes it drift; or "free": the
      offset is another in every epoch, so that only differences of ranges count. Ranges contain
      the offset, and the state has the range bias as its eighth component.
    * `survey`: None (default), "bad" or a `RandomSurvey`: in some episodes, angles, ranges and the
      anchors' places on the map have errors that all links share (docs/world-off.md).
    * `terminate_on_divergence`: see Episode End.
    * `render_mode`: "rgb_array" or "human", a window whose title lists its keyboard keys; needs
      the extra `render`.
    * `render_size`: height and width of pictures, 480 (default) to 1080.
    * `render_theme`: "light" (default) or "dark".
    * `backend`: "lanes", or "filterpy" for the same modes on filterpy's filters (slow; needs the
      extra `filterpy`).
    * `env_config`: all of these arguments in one mapping, passed by position (RLlib does this).

    ```python
    >>> import gymnasium as gym
    >>> env = gym.make("mmwave_env:MmWaveLoc-v0", scenario="vehicle")
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(1)

    ```

    ## Vectorized environment

    `gym.make_vec("mmwave_env:MmWaveLoc-v0", num_envs=1024)` steps all environments in one call
    of a compiled kernel; environment i behaves exactly like a single one with the same seed.
    Further arguments: `autoreset_mode` (a string: "NextStep", the default, "SameStep" or
    "Disabled") and `threads`. `render_mode="rgb_array"` draws the first 16 environments. "human"
    and `backend="filterpy"` need `vectorization_mode="sync"`.

    ## Version History

    * v0: initial version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium's own declaration
        "render_modes": ["human", "rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }
    _gallery: Gallery | None = None
    _spec: EnvSpec | None = None

    def __init__(
        self,
        env_config: Mapping[str, Any] | None = None,  # RLlib passes all arguments in one mapping
        /,
        **arguments: Any,
    ) -> None:
        self._begin(**(env_config or {}), **arguments)

    def _begin(
        self,
        *,
        observation: str = "full",
        backend: str = "lanes",
        render_mode: str | None = None,
        render_size: int = SMALLEST,
        render_theme: str = "light",
        **arguments: Any,
    ) -> None:
        if render_mode is not None:
            choose(dict.fromkeys(self.metadata["render_modes"]), render_mode, "render_mode")
            require_drawable(render_size, render_theme, f"render_mode={render_mode!r}")
            if render_mode == "human":
                from mmwave_env.rendering.window import require_display

                require_display()
        choose(BACKENDS, backend, "backend")
        self.render_mode = render_mode
        self._backend = backend
        self._take_task(task_from(**arguments), observation)
        self._over = True
        if render_mode:
            self._gallery = Gallery(1, *self._drawn, render_size, render_theme)
        self.observation_space = cast(Any, self.observation.space)
        self.action_space = space_of(self._limits, len(self.observation.actions))

    @property  # type: ignore[override]
    def spec(self) -> EnvSpec | None:
        """Return the registered specification; wrappers read the length of episodes from it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        epochs = getattr(self.source, "epochs", None)
        self._spec = spec and replace(spec, max_episode_steps=epochs)
        # If `gym.make` itself truncates an episode, the last step has no metrics. `gym.make` keeps
        # its limit of steps only in a local variable, which is read here: the specification that it
        # sets has no limit, and it calls nothing of ours after it has added its time limit.
        make = sys._getframe(1).f_locals
        limit = make.get("max_episode_steps") or getattr(
            make.get("env_spec"), "max_episode_steps", None
        )
        if epochs is not None and limit is not None and 0 < limit < epochs:
            raise ValueError(
                f"max_episode_steps: found {limit}, expected None or {epochs}; use episode_steps= "
                "for shorter episodes, so that the last info contains their metrics"
            )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array32, Info]:
        """Draw an episode; the same seed draws the same episode. See Gymnasium's `Env.reset`.

        ``options={"episode_key": k}`` plays an episode again; k is its key, from an earlier info.
        """
        (key,) = options_of(options, "episode_key")
        keys = None
        if key is not None:
            self._task.require_keys(seed)
            keys = np.array([key_from(key)], np.uint64)
        super().reset(seed=seed, options=options)
        if keys is None and self._task.has_keys:
            self._streams.follow(0, self.np_random, self.np_random_seed)
        infos = self._begin_episodes(_HERE, keys)
        observations, state = self._run_first_epoch(_HERE)
        self._begun = True
        self._over = False
        self._begin_pictures(_HERE)
        if self.render_mode == "human":
            self.render()
        return observations[0], {key: values[0] for key, values in (infos | state).items()}

    def _generator(self, place: int) -> np.random.Generator:
        return self.np_random

    def step(self, action: Any) -> tuple[Array32, float, bool, bool, Info]:
        """Process an epoch: apply a mode, weights or a correction. See Gymnasium's `Env.step`."""
        if self._over:
            raise ResetNeeded("Call reset before step: there is no episode under way.")
        actions, numbers = self._checked(action)
        result, _, infos = self._step_engine(actions, numbers)
        self._score(result, _HERE)
        terminated = bool(result.terminated[0])
        truncated = bool(result.truncated[0])
        self._over = terminated or truncated
        info = {key: values[0] for key, values in infos.items()}
        if self._over:
            info |= {key: values[0].item() for key, values in self._final_infos(_HERE).items()}
            if not info[NONFINITE_KEY]:
                del info[NONFINITE_KEY]
        if self._gallery:
            self._gallery.add(_HERE, actions, self._engine.column)
        if self.render_mode == "human":
            self.render()
        return result.observations[0], float(result.rewards[0]), terminated, truncated, info

    def _checked(self, action: Any) -> tuple[Index, Array | None]:
        """Return (mode (1,), None), or (zero (1,), numbers (1, k)) for an action in a `Box`."""
        if len(self._limits):
            return np.zeros(1, np.int64), numbers_in("action", action, self._limits)[None]
        # `contains` takes longer than the filters, so the usual actions are checked without it
        known = type(action) in _INTEGERS and 0 <= action < len(self.observation.actions)
        if not (known or self.action_space.contains(action)):
            raise InvalidAction(
                f"action: found {action!r} ({type(action)}), expected an integer in "
                f"{self.action_space}"
            )
        return np.array([action], np.int64), None

    def render(self) -> Pixels | None:
        """Draw the track, seen from above; return pixels (size, size, 3), or None for "human"."""
        if self._gallery is None:
            return None
        self._require_begun("render")
        (picture,) = self._gallery.draw()
        if self.render_mode == "rgb_array":
            return picture
        self._gallery.show(picture)
        return None

    def close(self) -> None:
        """Close the window if there is one."""
        if self._gallery:
            self._gallery.close()
