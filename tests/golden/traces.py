"""Golden traces: outputs of filters, smoother and environments; counts of operations and bytes.

A trace is a function that yields rows. A row maps columns to cells; its first cell names the row.
Episodes are given by their keys (64-bit numbers) instead of seeds: a new version of the package may
draw another key from the same seed, but a key always gives the same episode.
"""

from functools import partial

import gymnasium as gym
import numpy as np

from experiments.timing.roofline import count
from mmwave_env.datasets.recorded import TrackSource
from mmwave_env.datasets.samples import read_track
from mmwave_env.engines.engine import Engine
from mmwave_env.engines.epoch import Asked, decide, filter_epoch, program_of, score, untuned
from mmwave_env.filters import Pipeline
from mmwave_env.filters.bank import Bank, best_bank, default_modes, named_modes
from mmwave_env.filters.smoother import SMOOTHING_WINDOW
from mmwave_env.interface.policy import Switching
from mmwave_env.interface.reward import TrackingReward
from mmwave_env.localization.localizer import localize
from mmwave_env.logs.log import read_log
from mmwave_env.models.radio import radio_from
from mmwave_env.models.scene import read_scene, scene_from
from mmwave_env.vector_env import MmWaveLocVectorEnv
from mmwave_env.world.simulated import SimulatedSource
from tests.paths import LOGS

ID = "mmwave_env:MmWaveLoc-v0"
RADIO = "standard"  # profile of the receiver that measured the logs
STATE = ("px", "py", "pz", "vx", "vy", "vz", "b")
DIAGONAL = [i * (i + 3) // 2 for i in range(7)]  # indices of the variances in a packed covariance


# --- tracks of the measurement logs


def track(log, mode):
    """Filter a log with a mode, or with the IMM of the default modes ("imm"); yield some epochs."""
    block = _localized(log, mode)
    for k in _shown(block.x):
        yield (
            _belief(k, block.x, block.P)
            | _parts("nis", block.nis[k])
            | {"gates": _gates(block.visible[k], block.accepted[k])}
        )


def smoother(log, mode):
    """Smooth a log's track, filtered with a mode; yield means and variances of some epochs."""
    block = _localized(log, mode, window=SMOOTHING_WINDOW)
    for k in _shown(block.smooth_x):
        yield _belief(k, block.smooth_x, block.smooth_P)


def _localized(log, mode, window=None):
    scene = read_scene(LOGS / log / "scene.json")
    modes = Bank(default_modes(RADIO)) if mode == "imm" else (named_modes(RADIO)[mode],)
    rows = read_log(LOGS / log / "log.csv", scene).whole()
    return localize(rows, scene, radio_from(RADIO), Switching(modes), window=window)


def _shown(states):
    """Return the epochs to show: the first eight, then sixteen spread over the track."""
    return [*range(8), *np.linspace(8, len(states) - 1, 16).astype(int).tolist()]


def _belief(k, x, P):
    """Return the state (7,) of an epoch and the variances of its packed covariance (28,)."""
    variances = zip(STATE, P[k, DIAGONAL], strict=True)
    state = dict(zip(STATE, x[k], strict=True))
    return {"epoch": k} | state | {f"var {name}": variance for name, variance in variances}


def _gates(visible, accepted):
    """Return a letter per group of measurements: a (accepted), r (rejected) or - (missing)."""
    return "".join("-ra"[int(v) + int(v and a)] for v, a in zip(visible, accepted, strict=True))


def _parts(name, values):
    """Return one cell for a scalar or for flags, but one per element for an array of numbers."""
    if isinstance(values, np.ndarray) and values.dtype != np.bool_:
        return {f"{name} {i}": value for i, value in enumerate(values)}
    return {name: values}


# --- environments: everything that reset and step return


class Recorded(TrackSource):
    """Source of one episode of a recording: the same epochs with the same noise for every seed."""

    def sample(self, rng):
        """Return the episode."""
        return super().sample(np.random.Generator(np.random.PCG64(7)))


def rollout(keys, **arguments):
    """Play the episode of each key to its end; use the key None if the environment has no keys."""
    env = gym.make(ID, **arguments)
    for key in keys:
        options = None if key is None else {"episode_key": key}
        yield {"row": f"{key} reset"} | _cells(*env.reset(options=options))
        step = 0
        over = False
        while not over:
            step += 1
            action = _action(step, env)
            observation, *scores, info = env.step(action)
            over = scores[1] or scores[2]
            yield _scored(f"{key} step {step}", action, *scores) | _cells(observation, info)


def vector_rollout(keys, later, **arguments):
    """Play ``keys[i]`` in environment i; if this episode ends early, then play ``later[i]``.

    Between these episodes, autoreset begins another episode, which is not part of the trace.
    """
    n = len(keys)
    env = gym.make_vec(ID, num_envs=n, autoreset_mode="SameStep", **arguments)
    observations, infos = env.reset(options={"episode_key": keys})
    for i in range(n):
        yield {"row": f"{i} reset"} | _cells(observations[i], _of(i, infos))
    for step in range(1, arguments["episode_steps"] + 1):
        actions = np.array([_action(step + i, env) for i in range(n)])
        observations, *scores, infos = env.step(actions)
        over = scores[1] | scores[2]
        for i, values in enumerate(zip(actions, *scores, strict=True)):
            observation = observations[i]
            info = infos
            if over[i]:
                observation = infos["final_obs"][i]
                info = infos["final_info"]
            yield _scored(f"{i} step {step}", *values) | _cells(observation, _of(i, info))
        if over.any() and step < arguments["episode_steps"]:
            options = {"reset_mask": over, "episode_key": later}
            observations, infos = env.reset(options=options)
            for i in np.flatnonzero(over):
                yield {"row": f"{i} reset {step}"} | _cells(observations[i], _of(i, infos))


def _action(step, env):
    """Return an action that depends only on the step and on the number of actions."""
    space = env.single_action_space if isinstance(env, gym.vector.VectorEnv) else env.action_space
    return step * (step + 1) // 2 % int(space.n)


def _scored(row, action, reward, terminated, truncated):
    ends = {"terminated": terminated, "truncated": truncated}
    return {"row": row, "action": action, "reward": reward} | ends


def _of(i, infos):
    """Return the part of a vector environment's infos that belongs to environment i."""
    keys = [key for key in infos if key[0] != "_" and not key.startswith("final")]
    return {key: infos[key][i] for key in keys if infos[f"_{key}"][i]}


def _cells(observation, info):
    cells = {}
    for key in sorted(info):
        cells |= _parts(key, info[key])
    return cells | _parts("observation", observation)


# --- costs, in units that do not depend on a clock


def operations():
    """Count every kernel's SIMD instructions, which work on eight environments at a time."""
    source = SimulatedSource(scene_from("street"), radio_from("handset"))
    modes = named_modes("handset")
    reward = TrackingReward()
    bank = best_bank()
    both = Pipeline(default_modes(), source.layout)
    five = Pipeline(bank.modes, source.layout)
    whole = (filter_epoch, decide, score)
    programs = {}
    for name in ("ekf", "ukf", "ckf", "ekf-robust", "ukf-robust"):
        alone = untuned(Pipeline((modes[name],), source.layout))
        programs[f"track {name}"] = program_of(Asked(alone, predicted=True), whole)
    programs["step, shared beliefs"] = Engine(both, 1, reward).program
    programs["step, per-mode beliefs"] = Engine(five, 1, reward, bank=bank).program
    imm = Asked(untuned(five), True, reward=reward, action="", predicted=True)
    programs["IMM of five modes"] = program_of(imm, whole)
    kernels = {name: (program.function, program.template) for name, program in programs.items()}
    for name, part in zip(("measured", "happens", "substep"), source.world.parts, strict=True):
        kernels[f"world: {name}"] = part, source.world.template
    for name, kernel in kernels.items():
        yield {"kernel": name} | count(*kernel)._asdict()


def memory():
    """Count the bytes that one of 64 environments keeps from step to step."""
    for beliefs in ("shared", "per-mode"):
        env = MmWaveLocVectorEnv(64, beliefs=beliefs)
        env.reset(seed=0)
        for name, array in _arrays(env).items():
            yield {"array": f"{beliefs}: {name}", "bytes": array.nbytes // 64}


def _arrays(env):
    """Return the arrays that later steps of environments depend on."""
    tracks = env._engine.state
    counts = env._tally.counts
    return {
        "rows": tracks.rows,
        "worlds": tracks.feed.kept,
        "table": tracks.table,
        "length": tracks.length,
        "epoch": tracks.epoch,
        "keys": env._keys,
        "sums": counts.sums,
        "errors": counts.errors,
        "second": counts.second,
        "streams": env._streams._states,
        "over": env._over,
    }


# Estimates diverge in the episodes of keys 3656569636567469460 and 9573841816382471088.
TRACES = {
    "track-ekf": partial(track, "canyon28_pedestrian", "ekf"),
    "track-ukf": partial(track, "canyon28_vehicle", "ukf"),
    "track-imm": partial(track, "canyon28_vehicle", "imm"),
    "smoother": partial(smoother, "canyon28_pedestrian", "ekf"),
    "rollout-mixed": partial(
        rollout, [11749869230777074271, 2**64 - 1], episode_steps=12
    ),
    "rollout-diverging": partial(
        rollout, [3656569636567469460], episode_steps=14, scenario="vehicle",
        terminate_on_divergence=True,
    ),
    "rollout-recorded": lambda: rollout(
        [None], episodes=Recorded(read_track("canyon28_vehicle"), RADIO, epochs=8)
    ),
    "rollout-per-mode": partial(
        rollout, [9441442522235856127], episode_steps=8, beliefs="per-mode", radio=RADIO,
        scene="dynamic-doppler", dt=0.5, planar=True, odometry=True,
    ),
    "rollout-vector": partial(
        vector_rollout, [9573841816382471088, 6847638017495587239], [2, 3], episode_steps=12,
        scenario="vehicle", radio="high", observation="prior", reward="log-score",
        terminate_on_divergence=True,
    ),
    "operations": operations,
    "memory": memory,
}  # fmt: skip
