"""Rollouts of environments as tables: all that ``reset`` and ``step`` return, call by call."""

from collections.abc import Container, Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from tests.golden.text import table, word

ID = "mmwave_env:MmWaveLoc-v0"
ENVS = 3  # of a vector environment
FINAL = ("final_obs", "final_info")
MASKED_AFTER = 4  # steps one of them is reset, so that they end at different times
STEPS = 12  # of an episode, if nothing else is said
EARLY = {"terminate_on_divergence": True, "scenario": "vehicle"}
FLAT = {"radio": "standard", "planar": True, "odometry": True}
PRIOR = {"radio": "high", "observation": "prior", "reward": "log-score"}
LOST = {"episode_steps": 16, "seed": 711} | EARLY | PRIOR
EIGHT = {"modes": "extended", "steps": 5}  # without an end: what that runs takes long to compile
PER_MODE = {"beliefs": "per-mode", "episode_steps": 6}

# Environments of a group share a compiled program: all that is compiled into it (modes, the profile
# that tunes them, layout, observation, reward) is the same. ``steps`` are those of the rollout.
# Seeds other than 0 are of episodes that diverge.
ROLLOUTS: dict[str, dict[str, dict[str, Any]]] = {
    "handset": {
        "mixed": {"episode_steps": 16},
        "pedestrian": {"scenario": "pedestrian"},
        "vehicle": {"scenario": "vehicle", "scene": "dynamic-doppler"},
        "walk-ride": {"scenario": "walk-ride", "dt": 0.5},
        "jam": {"scenario": "jam", "scene": "o1"},
        "cyclist": {"scenario": "cyclist"},
        "recorded": {"episodes": "canyon28_vehicle"},
        "diverging": {"episode_steps": 14, "seed": 603} | EARLY,
        "next-step": {"autoreset_mode": "NextStep", "episode_steps": 14, "seed": 603} | EARLY,
    },
    "standard": {
        "pedestrian": {"scenario": "pedestrian"} | FLAT,
        "cyclist": {"scenario": "cyclist"} | FLAT,
        "same-step": {"autoreset_mode": "SameStep"} | FLAT,
    },
    "high": {
        "vehicle": {"scenario": "vehicle"} | PRIOR,
        "mixed": PRIOR,
        "next-step": {"autoreset_mode": "NextStep", "scenario": "jam"} | PRIOR,
        "same-step": {"autoreset_mode": "SameStep"} | LOST,
        "disabled": {"autoreset_mode": "Disabled"} | LOST,
    },
    "extended": {
        "mixed": EIGHT,
        "jam": {"scenario": "jam"} | EIGHT,
        "next-step": {"autoreset_mode": "NextStep"} | EIGHT,
    },
    "per-mode": {  # the tunings of the two radios' banks are data of one program
        "handset": {"scene": "dynamic-doppler"} | PER_MODE,
        "standard": {"radio": "standard", "dt": 0.1} | PER_MODE,
        "next-step": {"autoreset_mode": "NextStep", "radio": "standard"} | PER_MODE,
        "same-step": {"autoreset_mode": "SameStep", "seed": 1} | PER_MODE,
    },
}

Row = dict[str, object]


def rollout(steps: int | None = None, seed: int = 0, **arguments: Any) -> str:
    """What an environment tells from a reset with a seed on, with actions of the same seed."""
    arguments = {"episode_steps": STEPS} | arguments
    steps = arguments["episode_steps"] + 1 if steps is None else steps  # past an end
    rows = list((_three if "autoreset_mode" in arguments else _one)(steps, seed, arguments))
    said = " ".join(f"{name}={value}" for name, value in arguments.items())
    what = f"{steps} steps, seed={seed} {said}; ~ marks what a mask hides"
    first = ["row", "action", "reward", "terminated", "truncated"]
    others = sorted({name for row in rows for name in row} - set(first), key=_in_order)
    return table(what, first + others, rows)


def _in_order(column: str) -> tuple[bool, str, int]:
    """Infos by name and number, then the observation, of which there is most."""
    name, _, number = column.partition(" ")
    return name == "observation", name, int(number or 0)


def _one(steps: int, seed: int, arguments: dict[str, Any]) -> Iterator[Row]:
    env, actions = gym.make(ID, smoothed=True, **arguments), np.random.default_rng(seed)
    yield {"row": "0 reset"} | _told(*env.reset(seed=seed))
    for step in range(1, steps + 1):
        action = actions.integers(env.action_space.n)
        observation, *scores, info = env.step(action)
        yield _scored(f"{step} step", action, *scores) | _told(observation, info)
        if scores[1] or scores[2]:
            yield {"row": f"{step} reset"} | _told(*env.reset())


def _three(steps: int, seed: int, arguments: dict[str, Any]) -> Iterator[Row]:
    env, actions = (
        gym.make_vec(ID, num_envs=ENVS, smoothed=True, **arguments),
        np.random.default_rng(seed),
    )
    yield from _resets(0, *env.reset(seed=seed))
    for step in range(1, steps + 1):
        chosen = actions.integers(env.single_action_space.n, size=ENVS)
        observations, *scores, infos = env.step(chosen)
        for i, values in enumerate(zip(chosen, *scores, strict=True)):
            yield _scored(f"{step} step {i}", *values) | _told(observations[i], *_of(i, infos))
        for i in np.flatnonzero(infos.get("_final_info", [])):
            final = infos["final_obs"][i], *_of(i, infos["final_info"])
            yield {"row": f"{step} final {i}"} | _told(*final)
        over = np.zeros(ENVS, np.bool_)
        if arguments["autoreset_mode"] == "Disabled":
            over = scores[1] | scores[2]
        over[1] |= step == MASKED_AFTER
        if over.any():
            yield from _resets(step, *env.reset(options={"reset_mask": over}))


def _resets(step: int, observations: Any, infos: dict[str, Any]) -> Iterator[Row]:
    for i, observation in enumerate(observations):
        info, masked = _of(i, infos)  # where all is masked, the observation stays as it was
        yield {"row": f"{step} reset {i}"} | _told([] if masked else observation, info, masked)


def _scored(row: str, action: Any, reward: Any, terminated: Any, truncated: Any) -> Row:
    scores = {"reward": reward, "terminated": terminated, "truncated": truncated}
    return {"row": row, "action": action} | scores


def _of(i: int, infos: Mapping[str, Any]) -> tuple[dict[str, Any], set[str]]:
    """What a vector environment's infos tell of one environment, and which keys are masked."""
    keys = [key for key in infos if not key.startswith("_")]
    info = {key: "in row final" if key in FINAL else infos[key][i] for key in keys}
    return info, {key for key in keys if not infos[f"_{key}"][i]}


def _told(observation: Any, info: Mapping[str, Any], masked: Container[str] = ()) -> Row:
    """Cells of an observation and an info; ~ marks a value that a mask hides."""
    row: Row = {f"observation {k}": number for k, number in enumerate(observation)}
    for key, value in info.items():
        parts = {key: value}
        if isinstance(value, np.ndarray) and value.dtype != np.bool_:
            parts = {f"{key} {k}": number for k, number in enumerate(value)}
        row |= {name: f"~{word(v)}" for name, v in parts.items()} if key in masked else parts
    return row
