"""The step of many environments, from actions to infos, in one call of compiled code.

With few environments, Python's work around that call takes a third of a step or more, so the code
around it does not assemble or split arrays.
"""

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.advance import advance
from mmwave_env.compiler.disk_cache import LazyJit
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import PLAIN_BLOCK_EPOCHS, rows_of
from mmwave_env.compiler.threads import share
from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.tally import Tally, count
from mmwave_env.interface.info import (
    FLAGS,
    STATE_KEYS,
    mask_keys,
    told_rows,
)
from mmwave_env.numerics.numbers import Array, Index, Mask
from mmwave_env.numerics.pytree import flatten

Modes = NDArray[np.unsignedinteger]


class ActionHistory:
    """A ring buffer of the modes of the last T steps of n environments, one row per step.

    All environments step together, so an episode of k steps so far used the last k rows.

    Attributes:
        rows: (T, n) modes, in the smallest type that holds their number.
        turn: the row for the modes of the next step.
    """

    def __init__(self, n: int, modes: int) -> None:
        self.rows: Modes = np.zeros((0, n), np.min_scalar_type(modes))
        self.turn = 0

    def make_room(self, steps: int) -> None:
        """Make T at least this many steps; the modes stored so far are kept."""
        known = len(self.rows)
        if steps > known:
            longer = np.zeros((steps, self.rows.shape[1]), self.rows.dtype)
            longer[self._last(known) % steps] = self.rows[self._last(known) % known]
            self.rows = longer

    def next(self) -> None:
        """Go on to the next row, once the modes of a step are written."""
        self.turn = (self.turn + 1) % len(self.rows)

    def of(self, places: Index, steps: int) -> Modes:
        """Return the modes (places, steps) of the last steps, at most T, of some environments."""
        rows = self._last(steps) % len(self.rows)
        return np.ascontiguousarray(self.rows[:, places][rows].T)

    def all(self) -> Modes:
        """Return the modes (T, n) of the last T steps, oldest first; 0 where no step was made."""
        return self.rows[self._last(len(self.rows)) % len(self.rows)]

    def set_all(self, modes: Modes) -> None:
        """Restore the modes (T, n) that :meth:`all` returned."""
        self.rows, self.turn = modes.astype(self.rows.dtype), 0

    def _last(self, steps: int) -> Index:
        return np.arange(self.turn - steps, self.turn)


Infos = dict[str, NDArray[Any]]


class StepBuffers(NamedTuple):
    """The arrays that a step fills and returns."""

    observations: NDArray[np.float32]  # (n, features)
    rewards: Array  # (n,)
    terminated: Mask  # (n,)
    truncated: Mask  # (n,)

    @classmethod
    def fresh(cls, n: int, features: int) -> "StepBuffers":
        """Return new buffers for a step."""
        flags = np.zeros((2, n), np.bool_)
        return cls(np.empty((n, features), np.float32), np.empty(n), flags[0], flags[1])


class Stepper:
    """A stepper, which steps the environments of an engine and returns infos about them.

    Args:
        engine: the environments, on lanes.
        tally: sums for the metrics of current episodes.
        history: the modes of the last steps.
        infos: "all" for infos of every step, "episode" for infos on request, "none" for no infos.
    """

    def __init__(
        self,
        engine: Engine,
        tally: Tally,
        history: ActionHistory,
        infos: str = "all",
    ) -> None:
        at, n = engine.at, engine.batch.n
        self._known = {} if infos == "none" else told_rows(at)
        told = dict(self._known) if infos == "all" else {}
        flags = [told.pop(key) for key in FLAGS if key in told]
        # _step_blocks reads the first four of these
        tree = {"reward": at.reward, "nees": at.nees, "error": at.error, "flags": flags}
        tree |= {key: part for key, part in told.items() if key != "nees"}
        self._rows = rows_of(list(tree.values()))
        ends = np.cumsum([len(flatten(part)) for part in tree.values()]).tolist()
        self._columns = {
            name: (slice(None), 0, end - 1 if isinstance(part, int) else slice(begin, end))
            for (name, part), begin, end in zip(tree.items(), [0, *ends], ends, strict=False)
        }
        self._engine, self._told = engine, tuple(told)
        self._groups = len(at.memory.accepted) if told else 0
        self._action, self._obs_rows = rows_of(at.action), rows_of(at.observation)
        self._mask_keys = mask_keys([*self._told, *FLAGS, "mode"])
        self._everywhere = np.ones(n, np.bool_)
        self._outputs = np.empty((n, 1, len(self._rows)))
        self._tally, self._history = tally, history
        history.make_room(1)

    def step(self, actions: Index, out: StepBuffers) -> tuple[int, Infos]:
        """Commit every environment to its mode and consider the next epoch; see `Engine.step`.

        Args:
            actions: (n,) numbers of the modes; infos keep this array.
            out: filled with observations, with the reward function's rewards, and with truncated
                where the episode has no epoch left. ``terminated`` is not changed.

        Returns:
            The number of environments without epochs left; and fresh infos of all environments with
            their masks, if infos are wanted for every step.
        """
        batch, history, n = self._engine.batch, self._history, len(actions)
        flags = np.empty((2, n, self._groups), np.bool_)
        if self._told:
            self._outputs = np.empty_like(self._outputs)  # infos hold the previous array
        outputs, program, parts, tally = self._outputs, batch.program, batch.parts, self._tally
        arguments = (
            actions, history.rows, history.turn, out.rewards, flags, out.truncated,
            tally.sums, tally.errors, tally.second, tally.interval,
            program.on_lanes(), program.blank, *batch.state, self._action, self._rows, outputs,
            self._obs_rows, out.observations[:, None],
        )  # fmt: skip
        history.next()  # here, so that no interrupt can come between the step and this line
        if len(parts) == 1:
            [(begin, end)] = parts
            ended = _step(end - begin, begin, end, *arguments)
        else:
            jobs = [(end - begin, begin, end, *arguments) for begin, end in parts]
            ended = sum(share(_step, jobs, len(jobs)))
        if not self._told:
            return ended, {}
        at = self._columns
        infos: Infos = {key: outputs[at[key]] for key in self._told}
        infos |= {"accepted": flags[0], "rejected": flags[1], "mode": actions}
        infos |= dict.fromkeys(self._mask_keys, self._everywhere.copy())
        return ended, infos

    def look(self, actions: Index) -> Infos:
        """Return the infos of the last step, where infos are not returned by every step."""
        read = self._engine.read
        told = {
            key: read(part) > 0.5 if key in FLAGS else read(part)
            for key, part in self._known.items()
        }
        return told and told | {"mode": actions}

    @property
    def distances_m(self) -> Array:
        """Return the position errors (n,) in the epoch stepped last."""
        error = self._outputs[self._columns["error"]]
        return np.sqrt((error * error).sum(axis=1))  # type: ignore[no-any-return]

    def start(self, places: Index) -> tuple[NDArray[np.float32], Infos]:
        """Consider the first epoch in environments just loaded; leave the others unchanged.

        Returns:
            Observations (n, features) and the infos of :data:`STATE_KEYS` (n, ...), valid only for
            these environments.
        """
        observations, outputs = self._engine.start(places, self._rows)
        if self._told:
            told = {key: outputs[:, None][self._columns[key]] for key in STATE_KEYS}
        else:
            known = [key for key in STATE_KEYS if key in self._known]
            told = {key: self._engine.read(self._known[key]) for key in known}
        return observations, told


@register_jitable  # type: ignore[untyped-decorator]
def _step_blocks(  # type: ignore[no-untyped-def]
    begin, end, actions, noted, turn, rewards, flags, truncated, sums, errors, second, interval,
    run, blank, rows, feed, table, length, epoch, running, input_rows, output_rows, outputs,
    obs_rows, observations,
):  # fmt: skip
    """Step the environments of blocks ``begin`` to ``end``; return how many episodes ended."""
    n = len(actions)
    first, last = begin * WIDTH, min(end * WIDTH, n)
    inputs = np.empty((n, 1, 1))
    for e in range(first, last):
        inputs[e, 0, 0] = actions[e]
        noted[turn, e] = actions[e]
    advance(
        begin, end, run, blank, rows, feed, table, length, epoch, running, input_rows, inputs,
        output_rows, outputs, obs_rows, observations,
    )  # fmt: skip
    groups, ended = flags.shape[2], 0
    for e in range(first, last):
        rewards[e] = outputs[e, 0, 0]
        k = epoch[e] - 2  # the epoch before the one considered
        if k >= 0:
            nees, x, y, z = outputs[e, 0, 1], outputs[e, 0, 2], outputs[e, 0, 3], outputs[e, 0, 4]
            count(sums[e], errors[e], second[e], interval, k, x, y, z, nees)
        for flag in range(2):
            for i in range(groups):
                flags[flag, e, i] = outputs[e, 0, 5 + flag * groups + i] > 0.5
        truncated[e] = epoch[e] > length[e]
        ended += truncated[e]
    return ended


_step = LazyJit(_step_blocks, PLAIN_BLOCK_EPOCHS)
