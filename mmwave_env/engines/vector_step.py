"""A step of many environments, actions in and infos out, in one call of compiled code.

What Python does around that call costs few environments a third of their step and more, so nothing
is put together there and taken apart again.
"""

from typing import Any

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.lazy_jit import LazyJit
from mmwave_env.compiler.program import PLAIN_BLOCK_EPOCHS, advance, rows_of
from mmwave_env.compiler.threads import share
from mmwave_env.engines.action_history import ActionHistory
from mmwave_env.engines.env_engine import Engine
from mmwave_env.info import FLAGS, STATE_KEYS, mask_keys, told_rows
from mmwave_env.numerics.arrays import Array, Index, Mask
from mmwave_env.numerics.pytree import flatten

Infos = dict[str, NDArray[Any]]


class Stepper:
    """Steps the environments of an engine and tells of them.

    Args:
        engine: the environments, on lanes.

    Attributes:
        history: the modes they chose lately.
    """

    def __init__(self, engine: Engine) -> None:
        at, n, told = engine.at, engine.batch.n, told_rows(engine.at)
        flags = [told.pop(key) for key in FLAGS]
        tree = {"reward": at.reward, "flags": flags, **told}  # _step_blocks reads the first two
        self._rows = rows_of(list(tree.values()))
        ends = np.cumsum([len(flatten(part)) for part in tree.values()]).tolist()
        self._columns = {
            name: (slice(None), 0, end - 1 if isinstance(part, int) else slice(begin, end))
            for (name, part), begin, end in zip(tree.items(), [0, *ends], ends, strict=False)
        }
        self._engine, self._groups, self._told = engine, len(at.memory.accepted), tuple(told)
        self._action, self._obs_rows = rows_of(at.action), rows_of(at.observation)
        self._mask_keys = mask_keys([*self._told, *FLAGS, "mode"])
        self._everywhere = np.ones(n, np.bool_)
        self.history = ActionHistory(n, len(engine.observation.actions))

    def step(self, actions: Index) -> tuple[NDArray[np.float32], Array, Mask, int, Infos]:
        """Commit every environment to its mode and consider the next epoch; see `Engine.step`.

        Args:
            actions: (n,), taken over.

        Returns:
            Fresh arrays: observations (n, features); rewards (n,) as the reward function has them;
            (n,) True where the episode has no epoch left; how many these are; infos of all
            environments, with their masks.
        """
        batch, history, n = self._engine.batch, self.history, len(actions)
        observations = np.empty((n, 1, len(self._obs_rows)), np.float32)
        outputs, flags = (
            np.empty((n, 1, len(self._rows))),
            np.empty((2, n, self._groups), np.bool_),
        )
        rewards, truncated = np.empty(n), np.empty(n, np.bool_)
        program, parts = batch.program, batch.parts
        arguments = (
            actions, history.rows, history.turn, rewards, flags, truncated,
            program.on_lanes(), program.blank, *batch.state, self._action, self._rows, outputs,
            self._obs_rows, observations,
        )  # fmt: skip
        history.next()  # before an interrupt can come between the step and it
        if len(parts) == 1:
            [(begin, end)] = parts
            ended = _step(end - begin, begin, end, *arguments)
        else:
            jobs = [(end - begin, begin, end, *arguments) for begin, end in parts]
            ended = sum(share(_step, jobs, len(jobs)))
        at = self._columns
        infos: Infos = {key: outputs[at[key]] for key in self._told}
        infos |= {"accepted": flags[0], "rejected": flags[1], "mode": actions}
        infos |= dict.fromkeys(self._mask_keys, self._everywhere.copy())
        return observations[:, 0], rewards, truncated, ended, infos

    def start(self, places: Index) -> tuple[NDArray[np.float32], Infos]:
        """Consider the first epoch in environments just loaded; the others stay as they are.

        Returns:
            Observations (n, features) and what :data:`STATE_KEYS` tell (n, ...), sound only for
            these.
        """
        observations, outputs = self._engine.start(places, self._rows)
        return observations, {key: outputs[:, None][self._columns[key]] for key in STATE_KEYS}


@register_jitable  # type: ignore[untyped-decorator]
def _step_blocks(  # type: ignore[no-untyped-def]
    begin, end, actions, noted, turn, rewards, flags, truncated,
    run, blank, rows, table, length, epoch, running, input_rows, output_rows, outputs,
    obs_rows, observations,
):  # fmt: skip
    """Step the environments of blocks ``begin`` to ``end``; how many episodes ended."""
    n = len(actions)
    first, last = begin * WIDTH, min(end * WIDTH, n)
    inputs = np.empty((n, 1, 1))
    for e in range(first, last):
        inputs[e, 0, 0] = actions[e]
        noted[turn, e] = actions[e]
    advance(
        begin, end, run, blank, rows, table, length, epoch, running, input_rows, inputs,
        output_rows, outputs, obs_rows, observations,
    )  # fmt: skip
    groups, ended = flags.shape[2], 0
    for e in range(first, last):
        rewards[e] = outputs[e, 0, 0]
        for flag in range(2):
            for i in range(groups):
                flags[flag, e, i] = outputs[e, 0, 1 + flag * groups + i] > 0.5
        truncated[e] = epoch[e] > length[e]
        ended += truncated[e]
    return ended


_step = LazyJit(_step_blocks, PLAIN_BLOCK_EPOCHS)
