"""Vector environment: ``gymnasium.make_vec("MmWaveLoc-v0", num_envs=1024)``."""

import os
from collections.abc import Sequence
from math import inf
from typing import Annotated, Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from mmwave_env.engines.environment import Environment
from mmwave_env.interface.actions import numbers_in, space_of
from mmwave_env.interface.info import (
    NONFINITE_KEY,
    Info,
    mask_keys,
    masked,
    stepped,
)
from mmwave_env.io.lookup import choose
from mmwave_env.io.records import Bound, require
from mmwave_env.numerics.numbers import Array, Array32, Index, Mask
from mmwave_env.rendering.gallery import Gallery
from mmwave_env.rendering.theme import FRAMES_PER_SECOND, SMALLEST, Pixels, require_drawable
from mmwave_env.task import task_from
from mmwave_env.world.keys import Keys, keys_from, options_of

Step = tuple[Array32, Array, Mask, Mask, Info]

_OF_SINGLE = '; for other values use gymnasium.make, or make_vec with vectorization_mode="sync"'
Count = Annotated[int, Bound("an integer, at least 1", least=1, most=inf)]


class MmWaveLocVectorEnv(Environment, gym.vector.VectorEnv[Array32, Index, NDArray[Any]]):
    """N copies of :class:`~mmwave_env.env.MmWaveLocEnv`, stepped in one kernel call.

    Environment i has the same episodes, observations, rewards and infos, to the last bit, as a
    single environment with the same seed. ``reset(seed=s)`` gives environment i the seed s + i.

    Args:
        num_envs: number of environments N.
        autoreset_mode: "NextStep" (the step after the end of an episode ignores its action and
            resets), "SameStep" (the step that ends an episode also resets; the results of the old
            episode are in ``final_obs`` and ``final_info``) or "Disabled" (call
            ``reset(options={"reset_mask": mask})`` with a bool array (N,), True where to reset).
        threads: maximum number of threads; several are used only from N = 1024 on, where they
            save time. Results do not depend on this number.
        max_episode_steps: None or the length of the episodes; Gymnasium may pass this argument,
            which must agree with ``episode_steps``.
        render_mode: None or "rgb_array".
        render_size, render_theme: same as for the single environment.
        backend: "lanes"; vector environments have no other backend.
        **arguments: arguments of :class:`~mmwave_env.env.MmWaveLocEnv`.

    Attributes:
        autoreset_mode: a ``gymnasium.vector.AutoresetMode``.
    """

    _gallery: Gallery | None = None

    def __init__(
        self,
        num_envs: int = 1,
        *,
        autoreset_mode: str = "NextStep",
        threads: int = min(2, os.cpu_count() or 1),
        observation: str = "full",
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        render_size: int = SMALLEST,
        render_theme: str = "light",
        backend: str = "lanes",
        **arguments: Any,
    ) -> None:
        require("num_envs", num_envs, Count)
        require("threads", threads, Count)
        choose({"lanes": None}, backend, "backend", _OF_SINGLE)
        if render_mode is not None:
            choose({"rgb_array": None}, render_mode, "render_mode", _OF_SINGLE)
            require_drawable(render_size, render_theme, f"render_mode={render_mode!r}")
        self.render_mode = render_mode
        modes = {mode.value: mode for mode in AutoresetMode}
        self.autoreset_mode = choose(
            modes, cast(str, getattr(autoreset_mode, "value", autoreset_mode)), "autoreset_mode"
        )
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": FRAMES_PER_SECOND,
            "autoreset_mode": self.autoreset_mode,
        }
        self.num_envs = num_envs
        self._take_task(task_from(**arguments), observation, num_envs, threads)
        epochs = getattr(self._task.source, "epochs", None)
        if max_episode_steps not in (None, epochs):
            raise ValueError(
                f"max_episode_steps: found {max_episode_steps}, expected None or {epochs}; use "
                "episode_steps= for another length"
            )
        if render_mode:
            self._gallery = Gallery(num_envs, *self._drawn, render_size, render_theme)
        self.single_observation_space = self.observation.space
        self.single_action_space = space_of(self._limits, len(self.observation.actions))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._mode_count = np.array(len(self.observation.actions), np.uint64)
        self._places = np.arange(num_envs)
        self._none_over = np.zeros(num_envs, np.bool_)
        self._over = self._none_over
        self._ended = 0

    def render(self) -> tuple[Pixels, ...] | None:  # type: ignore[override]
        """Draw pictures (size, size, 3) of the first 16 environments; None without a render mode.

        Gymnasium's `wrappers.vector.RecordVideo` arranges these pictures in a grid.
        """
        if self._gallery is None:
            return None
        self._require_begun("render")
        return self._gallery.draw()

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array32, Info]:
        """Draw an episode for every environment, or only where ``options["reset_mask"]`` is True.

        Args:
            seed: s to seed environment i with s + i; or one seed per environment, where None
                continues the environment's stream of episodes.
            options: ``reset_mask`` is a bool array (N,); ``episode_key`` holds the keys (N,) of the
                episodes to play; keys of environments that are not reset are ignored.

        Returns:
            All observations (N, features), and the infos of the environments that were reset.
        """
        mask, keys = options_of(options, "reset_mask", "episode_key")
        chosen = self._reset_mask(mask)
        places = np.flatnonzero(chosen)
        if keys is not None:
            self._task.require_keys(seed)
            keys = keys_from(keys, self.num_envs)[places]
        self._begun &= not chosen.all()  # while all are being reset, no episode is under way
        self._streams.seed_some(seed, places)
        drawn = self._draw(places, keys)
        _, state = self._run_first_epoch(places)
        self._begun = True
        self._begin_pictures(places)
        return self._engine.observations(), masked(drawn | state, chosen)

    def _reset_mask(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        if not (
            isinstance(mask, np.ndarray)
            and mask.dtype == np.bool_
            and mask.shape == (self.num_envs,)
            and mask.any()
        ):
            raise ValueError(
                f"options['reset_mask']: found {mask!r}, expected a bool array of shape "
                f"({self.num_envs},) with at least one True"
            )
        if not (self._begun or mask.all()):
            raise ResetNeeded(
                "Reset all environments before you reset only some: no episode is under way."
            )
        return mask

    @property  # type: ignore[misc]
    def np_random(self) -> Any:
        """Return one random generator per environment, from which custom sources draw episodes."""
        return tuple(map(self._generator, range(self.num_envs)))

    @property
    def np_random_seed(self) -> Any:
        """Return the seed of each environment, as a `SyncVectorEnv` does."""
        return tuple(self._streams.seeds)

    def _draw(self, places: Index, keys: Keys | None = None) -> Info:
        """Begin episodes in the environments with indices ``places``; return infos, (N,) each."""
        infos = self._begin_episodes(places, keys)
        self._over = self._over.copy()
        self._over[places] = False
        self._ended = int(np.count_nonzero(self._over))
        return infos

    def step(self, actions: Index) -> Step:
        """Run an epoch in each environment; actions are modes (N,) or numbers (N, k) in a `Box`."""
        actions, numbers = self._checked(actions)
        # mask and number of environments to reset now
        fresh = self._over
        resets = self._ended
        drawn = self._draw(np.flatnonzero(fresh)) if resets else {}
        running = np.flatnonzero(~fresh) if resets else self._places
        result, self._ended, infos = self._step_engine(actions, numbers)
        infos |= dict.fromkeys(self._mask_keys, np.ones(self.num_envs, np.bool_))
        observations, rewards, terminated, truncated, *_ = result
        if self._gallery:
            self._begin_pictures(np.flatnonzero(fresh))
            self._gallery.add(running, actions, self._engine.column)
        self._score(result, running)
        if resets:
            rewards[fresh] = 0.0
            infos = stepped(infos, ~fresh) | masked(drawn, fresh)
        if self._task.worst is not None:
            self._ended = int(np.count_nonzero(terminated | truncated))
        self._over = self._none_over
        if self._ended:
            self._over = terminated | truncated
            infos = self._end(observations, infos)
        return observations, rewards, terminated, truncated, infos

    def _end(self, observations: Array32, infos: Info) -> Info:
        """Add the infos of ended episodes; begin new episodes if the autoreset mode is SameStep."""
        ended = np.flatnonzero(self._over)
        final = {}
        for key, values in self._final_infos(ended).items():
            final[key] = np.zeros(self.num_envs, values.dtype)
            final[key][ended] = values
        lost = final.pop(NONFINITE_KEY)
        infos |= masked(final, self._over) | masked({NONFINITE_KEY: lost}, lost > 0)
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            return self._same_step(observations, infos)
        return infos

    def _checked(self, actions: Any) -> tuple[Index, Array | None]:
        """Return copies: (modes (N,), None), or (zeros (N,), numbers (N, k)) for actions in a Box.

        Invalid actions are refused, except in environments that ignore their action.
        """
        self._require_begun("step")
        if self._ended and self.autoreset_mode == AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"The episodes of environments {np.flatnonzero(self._over).tolist()} are over: "
                'call reset(options={"reset_mask": ...}) before step.'
            )
        n = self.num_envs
        if len(self._limits):
            numbers = numbers_in("actions", actions, self._limits, n, ignored=self._over)
            return np.zeros(n, np.int64), numbers
        array = np.asarray(actions)
        if array.shape == (n,) and array.dtype.kind in "iu":
            chosen = array.astype(np.int64)
            wrong = chosen.view(np.uint64) >= self._mode_count  # negative actions become large
            if self._ended:
                wrong[self._over] = False
            if not np.count_nonzero(wrong):
                return chosen, None
        raise InvalidAction(
            f"actions: found {actions!r}, expected {n} integers in {self.single_action_space}"
        )

    def _same_step(self, observations: Array32, infos: Info) -> Info:
        """Reset environments whose episodes ended; put their old infos into ``final_info``."""
        over = self._over.copy()
        ended = np.flatnonzero(over)
        final_obs = np.full(self.num_envs, None, object)
        for place, observation in zip(ended, observations[ended], strict=True):
            final_obs[place] = observation.copy()
        values = {key: array.copy() for key, array in infos.items() if not key.startswith("_")}
        final = masked(values, over)
        if NONFINITE_KEY in final:
            (mask,) = mask_keys([NONFINITE_KEY])
            final[mask] = final[NONFINITE_KEY] > 0
        drawn = self._draw(ended)
        first, begun = self._run_first_epoch(ended)
        observations[ended] = first[ended]
        self._begin_pictures(ended)
        for key, anew in begun.items():
            infos[key][ended] = anew[ended]
        infos = stepped(infos, ~over)
        infos |= masked(drawn, over) | {"final_obs": final_obs, "final_info": final}
        return infos | {key: over.copy() for key in mask_keys(["final_obs", "final_info"])}
