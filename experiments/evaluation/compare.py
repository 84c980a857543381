"""Comparison of a user's agents with known contenders in one call, :func:`compare`."""

import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from numbers import Integral
from typing import Any

from experiments.evaluation.agents import Act
from experiments.evaluation.comparison import Comparison, compare_scores
from experiments.evaluation.contenders import Contender, contender_from
from experiments.evaluation.runner import Scoring, score_contenders
from experiments.evaluation.seeds import seeds_from
from mmwave_env.filters.bank import Modes
from mmwave_env.interface.reward import reward_name
from mmwave_env.io.files import AnyPath
from mmwave_env.io.lookup import printable
from mmwave_env.task import task_from
from mmwave_env.world.episode import EpisodeSource

USUAL_EPISODES = 200
Agent = AnyPath | Act


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Print every warning once, on one line, without the line of our code that caused it."""
    with warnings.catch_warnings(action="once"):
        warnings.showwarning = lambda message, *_: print(
            f"warning: {printable(str(message))}", file=sys.stderr
        )
        yield


@_warnings_in_lines()
def compare(
    policies: Mapping[str, Agent],
    beside: Sequence[str] = ("fixed-ukf", "speed-rule", "imm"),
    scenario: str | None = None,
    radio: str = "handset",
    episodes: int | None = None,
    seed: int | None = None,
    modes: Modes = None,
    observation: str = "full",
    data: AnyPath | EpisodeSource | None = None,
    beliefs: str = "shared",
    **world: Any,
) -> Comparison:
    """Compare a user's agents with known contenders on the same episodes.

    Args:
        policies: agents, by the names to show in tables. An agent is either a function that maps
            observations (n, features), float32, of ``n`` episodes to ``n`` integer actions, or
            anything that ``mmwave-loc compare --policies`` accepts: a policy file,
            "module:function", a run's folder, or a contender's name. docs/own-agent.md describes
            the methods (``reset``, ``correct``) and attributes (``modes``, ``observation``,
            ``beliefs``, which override the arguments) that a function may have.
        beside: names of known contenders to compare with, none or several, from
            :func:`~experiments.evaluation.contenders.contenders`.
        scenario, radio: same as in the environment.
        episodes: number of episodes, 200 by default; results to publish need 1000 or more.
        seed: seed of the first episode, 0 by default; training uses seeds from 10 million on.
        modes, observation, beliefs: settings that agents were trained with, as in the environment;
            policy files have their own. An agent given as "imm" is an IMM that mixes these modes;
            a bank or file in ``modes`` also sets its transition probabilities and NIS quantile.
        data: recorded episodes or episodes of your own, as in the environment's ``episodes``.
        world: further arguments of the environment: ``scene``, ``dt``, ``episode_steps``,
            ``planar``, ``odometry``, ``reward``.

    Returns:
        The metrics of all contenders, and paired differences: each of the user's agents against
        every other contender, and the pairs of known contenders that ``mmwave-loc compare`` shows.

    Raises:
        ValueError: an argument is not valid, an agent fails to load, raises, or does not return
            actions. Only agents that fail in an episode raise errors after episodes have run.
        FileNotFoundError: a file that an argument names does not exist.
    """
    _require_valid(policies, episodes, beside, world)
    task = task_from(scenario=scenario, radio=radio, episodes=data, **world)
    scoring = Scoring.of(task)
    seeds = seeds_from(episodes, seed, USUAL_EPISODES)
    settings = (radio, modes, observation, beliefs)
    everybody = [_contender(name, agent, *settings) for name, agent in policies.items()]
    everybody += [contender_from(name, radio) for name in beside]
    scores = score_contenders(everybody, task.source, seeds, scoring=scoring)
    return compare_scores(
        scores,
        list(policies),
        scenario=task.source.name,
        radio=task.radio.name,
        seeds=seeds,
        reward=reward_name(scoring.reward),
    )


def _require_valid(
    policies: object, episodes: object, beside: object, world: Mapping[str, Any]
) -> None:
    """Refuse arguments of :func:`compare` of a wrong type or name."""
    if not isinstance(policies, Mapping):
        raise ValueError(
            f"policies: found a {type(policies).__name__}, expected a dict of agents by name, such "
            "as {'mine': act}"
        )
    if isinstance(beside, str):
        raise ValueError(
            f"beside: found {beside!r}, expected a list of names, such as ['{beside}']"
        )
    if not isinstance(episodes, Integral | None):
        raise ValueError(
            f"episodes: found {episodes!r}, expected a number of episodes; recordings and logs are "
            "passed as data="
        )
    if wrong := sorted({"action", "base", "terminate_on_divergence"} & world.keys()):
        raise ValueError(f"{wrong[0]}: not an argument of compare, which plays complete episodes")


def _contender(name: str, agent: Agent, *settings: Any) -> Contender:
    """Return the contender of an agent; the settings are radio, modes, observation, beliefs."""
    if isinstance(agent, (str, os.PathLike)):
        return replace(contender_from(os.fspath(agent), *settings), name=name)
    return Contender.own(name, agent, *settings)
