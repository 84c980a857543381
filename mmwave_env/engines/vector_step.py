"""The step of many environments, from actions to infos, in one call of compiled code.

With few environments, the Python code around that call takes a third of a step's time or more. So
the Python code neither assembles nor splits arrays.
"""

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from mmwave_env.compiler.advance import advance
from mmwave_env.compiler.disk_cache import LazyJit
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.compiler.program import PLAIN_BLOCK_EPOCHS, Repeated, StepIO, laid_out
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.tally import Tally, count, exceeds
from mmwave_env.interface.info import (
    COST_KEY,
    FLAGS,
    STATE_KEYS,
    Info,
    info_rows,
    mask_keys,
    reported,
)
from mmwave_env.numerics.numbers import Array, Index, Mask


class StepResult(NamedTuple):
    """The arrays that a step of n environments fills."""

    observations: NDArray[np.float32]  # (n, features)
    rewards: Array  # (n,) results of the reward function
    terminated: Mask  # (n,) False; the caller sets it where a track diverges
    truncated: Mask  # (n,) whether the episode has no epoch left
    # accepted, rejected: (n, groups) the gates' verdicts; (n, 0) if steps return no infos
    accepted: Mask
    rejected: Mask
    cost: Array  # (n,) 1.0 where an error exceeds its protection level; (0,) if infos are "none"


# The first output columns: reward, NEES, three columns of position error, and three of the
# covariance of the horizontal position; then, if steps return infos, the gates' verdicts.
REWARD = 0
NEES = 1
ERROR = 2
COVARIANCE = 5
VERDICTS = 8


class Stepper:
    """An object that steps the environments of an engine and returns infos about them.

    Args:
        engine: the environments.
        tally: records of current episodes.
        infos: "all" if :meth:`step` returns infos, "episode" if :meth:`look` does, "none" if
            neither does.
    """

    def __init__(self, engine: Engine, tally: Tally, infos: str) -> None:
        at = engine.at
        self._known = {} if infos == "none" else info_rows(at)
        shown = self._known if infos == "all" else {}
        parts = {"reward": at.reward, "nees": at.nees, "error": at.error}
        parts["covariance"] = reported(at).P[:3]
        parts |= {key: [] for key in FLAGS} | shown
        self._rows, columns = laid_out(parts)
        self._columns = {name: (slice(None), 0, at) for name, at in columns.items()}
        self._engine = engine
        self._info_keys = tuple(key for key in shown if key not in FLAGS)
        self._groups = len(at.memory.accepted) if shown else 0
        self._io = engine.step_io(self._rows)
        self.mask_keys = mask_keys([*shown, "mode", COST_KEY])  # of infos from steps
        self._tally = tally
        self._run = Repeated(_step)

    def step(self, actions: Index, numbers: Array | None) -> tuple[StepResult, int, Info]:
        """Apply all actions and run the modes on the next epoch, as :meth:`Engine.step` does.

        Args:
            actions: (n,) numbers of the modes; infos contain this array itself, not a copy.
            numbers: (n, k) the agents' weights of the modes or corrections of the beliefs;
                ``actions`` must then be zeros. None if the agents choose modes.

        Returns:
            New results; the number of environments that have no epoch left; and new infos about all
            environments, without Gymnasium's masks, or {} if steps return no infos.
        """
        engine = self._engine
        io = self._io
        n = len(actions)
        features = len(io.obs_rows)
        if numbers is not None:
            io.inputs[:, 0, 1:] = numbers
        ends = np.zeros((2, n), np.bool_)
        flags = np.empty((2, n, self._groups), np.bool_)
        observations = np.empty((n, 1, features), np.float32)
        self._costs = costs = np.empty(n if self._known else 0)
        result = StepResult(
            observations[:, 0], np.empty(n), ends[0], ends[1], flags[0], flags[1], costs
        )
        # Info need new arrays of outputs, as earlier infos are views of the previous arrays.
        outputs = np.empty_like(io.outputs) if self._info_keys else io.outputs
        io = StepIO(io.input_rows, io.inputs, self._rows, outputs, io.obs_rows, observations)
        self._io = io
        records = (engine.program.blank, engine.state, io, actions, result, self._tally.counts)
        blocks = len(engine.state.rows)
        if engine.on_floats:
            io.inputs[:, 0, 0] = actions
            engine.advance(io)
            ended = _step_blocks(0, blocks, 0, *records)
        else:
            run = engine.program.on_lanes()
            parts = engine.parts
            ended = sum(self._run(blocks, parts, len(parts), run, *records))
        engine.trust(io)
        if not self._info_keys:
            return result, ended, {}
        infos: Info = {key: outputs[self._columns[key]] for key in self._info_keys}
        infos |= {"accepted": result.accepted, "rejected": result.rejected, "mode": actions}
        infos[COST_KEY] = result.cost
        return result, ended, infos

    def look(self, actions: Index) -> Info:
        """Return the infos about the last step, for steppers whose steps return no infos."""
        infos = {key: self._engine.read(part) for key, part in self._known.items()}
        infos |= {key: infos[key] > 0.5 for key in FLAGS if infos}
        return infos and infos | {"mode": actions, COST_KEY: self._costs.copy()}

    @property
    def distances_m(self) -> Array:
        """Return the lengths (n,) of the position errors in the last step."""
        error = self._io.outputs[self._columns["error"]]
        return np.sqrt((error * error).sum(axis=1))  # type: ignore[no-any-return]

    def start(self, places: Index) -> tuple[NDArray[np.float32], Info]:
        """Run the modes on the next epoch in environments just loaded; leave the others unchanged.

        Returns:
            Observations (n, features) and the infos of :data:`STATE_KEYS` (n, ...), valid only for
            the environments ``places``.
        """
        observations, outputs = self._engine.start(places, self._rows)
        if self._info_keys:
            return observations, {key: outputs[:, None][self._columns[key]] for key in STATE_KEYS}
        known = [key for key in STATE_KEYS if key in self._known]
        return observations, {key: self._engine.read(self._known[key]) for key in known}


@register_jitable  # type: ignore[untyped-decorator]
def _step_blocks(  # type: ignore[no-untyped-def]
    begin, end, run, blank, state, io, actions, result, counts
):
    """Step the environments of blocks ``begin`` to ``end`` - 1; return how many episodes ended.

    If ``run`` is 0, the program has run already, and only the results are filled.
    """
    first = begin * WIDTH
    last = min(end * WIDTH, len(actions))
    inputs = io.inputs
    outputs = io.outputs
    epoch = state.epoch
    length = state.length
    if run != 0:
        for e in range(first, last):
            inputs[e, 0, 0] = actions[e]
        advance(begin, end, run, blank, state, io)
    _, rewards, _, truncated, accepted, rejected, costs = result
    ended = 0
    for e in range(first, last):
        rewards[e] = outputs[e, 0, REWARD]
        x = outputs[e, 0, ERROR]
        y = outputs[e, 0, ERROR + 1]
        z = outputs[e, 0, ERROR + 2]
        k = epoch[e] - 2  # the epoch that the action completed
        if k >= 0:
            count(counts, e, k, x, y, z, outputs[e, 0, NEES])
            if k < len(counts.modes):
                counts.modes[k, e] = actions[e]
        if len(costs):
            xx = outputs[e, 0, COVARIANCE]
            xy = outputs[e, 0, COVARIANCE + 1]
            yy = outputs[e, 0, COVARIANCE + 2]
            costs[e] = exceeds(x, y, xx, xy, yy)
        for g in range(accepted.shape[1]):
            accepted[e, g] = outputs[e, 0, VERDICTS + g] > 0.5
            rejected[e, g] = outputs[e, 0, VERDICTS + accepted.shape[1] + g] > 0.5
        truncated[e] = epoch[e] > length[e]
        ended += truncated[e]
    return ended


_step = LazyJit(_step_blocks, PLAIN_BLOCK_EPOCHS)
