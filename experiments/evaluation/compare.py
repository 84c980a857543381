"""Agents of one's own beside those that are known, in one call: :func:`compare`."""

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
from experiments.evaluation.seeds import Selection
from mmwave_env.filters.bank import Modes
from mmwave_env.lookup import printable
from mmwave_env.reward import reward_name
from mmwave_env.task import task_from
from mmwave_env.world.episode import EpisodeSource

USUAL_EPISODES = 200


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Every warning is told once, in a line without the place in our code that it came from."""
    told: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        line = printable(str(message))
        if line not in told:
            told.add(line)
            print(f"warning: {line}", file=sys.stderr)

    usual, warnings.showwarning = warnings.showwarning, show
    try:
        yield
    finally:
        warnings.showwarning = usual


Agent = str | os.PathLike[str] | Act


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
    data: str | os.PathLike[str] | EpisodeSource | None = None,
    beliefs: str = "shared",
    **world: Any,
) -> Comparison:
    """Agents of one's own and known contenders on the same episodes.

    Args:
        policies: agents by the name they get in the tables. Each is a function from
            observations (n, features) float32, of ``n`` episodes at once, to actions (n,),
            integers; or whatever ``mmwave-loc compare --policies`` takes: a policy file,
            "module:function", the folder of a run, a name. A function may have a method
            ``reset(begins)`` (bool (n,): where an episode begins), and attributes ``modes``,
            ``observation`` and ``beliefs``, which go before the arguments here.
        beside: names of contenders, see :func:`~experiments.evaluation.contenders.contenders`.
        scenario, radio: as of the environment.
        episodes: how many, 200 where none is given; 1000 or more to publish.
        seed: of the first, 0 where none is given; test seeds start at 0 and belong to no training.
        modes, observation, beliefs: what agents of one's own were trained with, as of the
            environment. Policy files say it themselves; "imm" among the policies is over these
            modes, with the transition and quantile of a bank or of a file that says them.
        data: recorded or own episodes, as of the environment's ``episodes``.
        world: further arguments of the environment: ``scene``, ``dt``, ``episode_steps``,
            ``planar``, ``odometry``, ``reward``.

    Returns:
        The metrics of all, and their paired differences: of agents of one's own from everybody, of
        those beside them as ``mmwave-loc compare`` shows them. ``print`` shows it as Markdown.

    Raises:
        ValueError: no dict of policies, unknown scenario, radio or contender, a name twice, no
            number of episodes, or an agent that can't be loaded, fails, or returns no actions:
            before an episode runs.
        FileNotFoundError: there is no such file.
    """
    if not isinstance(policies, Mapping):
        raise ValueError(
            f"policies: found a {type(policies).__name__}, expected a dict of agents by name, such "
            "as {'mine': act}"
        )
    if not isinstance(episodes, Integral | None):
        raise ValueError(
            f"episodes: found {episodes!r}, expected how many; data= takes recordings and logs"
        )
    task = task_from(scenario=scenario, radio=radio, episodes=data, **world)
    scoring = Scoring.of(task)
    selection = Selection.of(episodes, seed, USUAL_EPISODES)

    def contender(name: str, agent: Agent) -> Contender:
        if not isinstance(agent, (str, os.PathLike)):
            return Contender.own(name, agent, radio, modes, observation, beliefs)
        found = contender_from(os.fspath(agent), radio, modes, observation, beliefs)
        return replace(found, name=name)

    own = [contender(name, agent) for name, agent in policies.items()]
    others = [contender_from(name, radio) for name in beside]
    everybody = [*own, *others]
    scores = score_contenders(everybody, task.source, radio, selection, scoring=scoring)
    return compare_scores(
        scores, list(policies), scenario=task.source.name, radio=task.radio.name,
        selection=selection, reward=reward_name(scoring.reward),
    )  # fmt: skip


def evaluate(policy: Agent, **where: Any) -> Comparison:
    """One agent, or one known contender, alone.

    Args:
        policy, where: as of :func:`compare`, which takes names beside it and shows differences.

    Returns:
        Its metrics with 95 % intervals; ``print`` shows it as Markdown.
    """
    if isinstance(policy, (str, os.PathLike)):
        name = os.fspath(policy)
    else:
        name = getattr(policy, "__name__", type(policy).__name__)
    return compare({name: policy}, (), **where)
