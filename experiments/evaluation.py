"""Run contenders on the same episodes and compare them (design: evaluation protocol).

A contender is a policy with the modes it chooses from, or the IMM. All see the same
episodes, so differences are paired; intervals are 95 % percentile bootstraps over episodes.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from experiments.intervals import Interval, bootstrap
from mmwave_env.engine import Engine
from mmwave_env.episode import Episode, EpisodeSource
from mmwave_env.estimator.modes import Mode, default_modes, named_modes
from mmwave_env.estimator.pipeline import Pipeline
from mmwave_env.estimator.program import rows_of
from mmwave_env.imm_engine import ImmEngine
from mmwave_env.measurement import Layout
from mmwave_env.metrics import METRICS, summary
from mmwave_env.names import choose
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward, TrackingReward
from policies import (
    FixedMode,
    LearnedSwitch,
    LikelihoodRule,
    Policy,
    RandomMode,
    SpeedRule,
    tuned_threshold,
)

Array = NDArray[np.float64]
Transition = tuple[tuple[float, ...], ...]
Scores = dict[str, Array]  # metric -> (episodes,)

CHUNK = 1000  # episodes in memory at once
POLICY_SEED = 0


@dataclass(frozen=True)
class Contender:
    """Something that localises.

    Attributes:
        name: as on the command line and in results.
        modes: what it works with.
        policy: from the observation table to a policy; None for the IMM over the modes.
        transition: probabilities (from, to) of the IMM; None for the default.
        observation: what the policy sees, "full" or "prior".
    """

    name: str
    modes: tuple[Mode, ...]
    policy: Callable[[Observation], Policy] | None
    transition: Transition | None = None
    observation: str = "full"

    @classmethod
    def learned(cls, path: str | os.PathLike[str], name: str | None = None) -> "Contender":
        """The switcher of a policy file, or a shipped one by its name.

        Args:
            path: as of :class:`~policies.LearnedSwitch`.
            name: in results; None for the path.
        """
        card = LearnedSwitch(path).card
        return cls(
            os.fspath(path) if name is None else name,
            card.modes,
            partial(LearnedSwitch, path),
            observation=card.observation,
        )

    def start(self, layout: Layout) -> Policy | None:
        """A new policy for measurements of a layout; None for the IMM."""
        table = Observation(Pipeline(self.modes, layout), self.observation)
        return self.policy and self.policy(table)


def _over(modes: tuple[Mode, ...]) -> list[Contender]:
    """The contenders that work with any modes: each of them alone, rules, chance and the IMM."""
    names = [mode.name for mode in modes]
    found = [Contender(f"fixed-{name}", modes, partial(_fixed, i)) for i, name in enumerate(names)]
    if len(modes) == 2:
        found.append(Contender("speed-rule", modes, SpeedRule))
    if len(modes) > 1:
        found.append(
            Contender("likelihood-rule", modes, lambda table: LikelihoodRule(table, names))
        )
        found.append(Contender("random", modes, lambda table: RandomMode(len(modes), POLICY_SEED)))
    return [*found, Contender("imm", modes, None)]


def _fixed(action: int, table: Observation) -> Policy:
    return FixedMode(action)


def contenders(radio: str, modes: tuple[Mode, ...] | None = None) -> dict[str, Contender]:
    """Every contender there is, by name.

    Args:
        radio: profile.
        modes: what they work with; None for the profile's two, beside which the profile has
            single modes of other kinds, a tuned threshold, and an IMM over robust modes.
    """
    if modes is not None:
        return {c.name: c for c in _over(modes)}
    two, named = default_modes(radio), named_modes(radio)
    others = [
        Contender(f"fixed-{name}", (named[name],), partial(_fixed, 0))
        for name in ("ckf", "ekf-robust", "ukf-robust")
    ]
    tuned = Contender(
        "speed-rule-tuned", two, lambda table: SpeedRule(table, tuned_threshold(radio))
    )
    robust = Contender("imm-robust", (named["ekf-robust"], named["ukf-robust"]), None)
    ekf, ukf, rule, *rest = _over(two)
    return {c.name: c for c in (ekf, ukf, *others, rule, tuned, *rest, robust)}


def contender_from(name: str, radio: str, modes: tuple[Mode, ...] | None = None) -> Contender:
    """A contender by name; see :func:`contenders`.

    Raises:
        ValueError: unknown name; the message lists the valid ones.
    """
    return choose(contenders(radio, modes), name, "policy")


def require_seeds(seeds: Sequence[int]) -> None:
    """Refuse an empty run, and seeds that are none.

    Raises:
        ValueError: no seeds, or a negative one.
    """
    if not len(seeds):
        raise ValueError("episodes: found none, expected at least 1")
    if min(seeds) < 0:
        raise ValueError(f"seed: found {min(seeds)}, expected 0 or more")


def draw_episodes(source: EpisodeSource, seeds: Sequence[int]) -> list[Episode]:
    """One episode per seed, the same that ``env.reset(seed=...)`` draws.

    Raises:
        ValueError: no seeds, or a negative one.
    """
    require_seeds(seeds)
    return [source.sample(np.random.default_rng(seed)) for seed in seeds]


def score(
    contender: Contender,
    policy: Policy | None,
    episodes: Sequence[Episode],
    reward: Reward | None = None,
) -> Scores:
    """Metrics per episode of a contender and its policy, on episodes of one length."""
    reward = reward or TrackingReward()
    for episode in episodes:
        episode.require_truth()
    pipeline = Pipeline(contender.modes, episodes[0].layout)
    if policy is None:
        imm = ImmEngine(pipeline, reward, contender.transition)
        told = imm.run(episodes, "reward", "nees", "error")
    else:
        told = _steered(pipeline, policy, contender, episodes, reward)
    times_s = episodes[0].time_s
    step_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 1.0
    return summary(told["reward"], told["error"], told["nees"], 1.0 / step_s)


def _steered(
    pipeline: Pipeline,
    policy: Policy,
    contender: Contender,
    episodes: Sequence[Episode],
    reward: Reward,
) -> dict[str, Array]:
    """Rewards (n, T), NEES (n, T) and errors (n, T, 3) where a policy picks the modes."""
    n, T = len(episodes), len(episodes[0])
    engine = Engine(pipeline, n, reward, contender.observation)
    engine.reset(episodes)
    policy.reset(np.ones(n, bool))
    program, names = engine.batch.program, ("reward", "nees", "error")
    scored = rows_of(program.parts(names))
    told = np.empty((n, T, len(scored)))
    observations = engine.observations()
    for t in range(T):
        actions = policy(observations)
        if actions.min() < 0 or actions.max() >= len(pipeline.modes):
            raise ValueError(
                f"actions of {contender.name}: found {actions.min()} to {actions.max()}, "
                f"expected 0 to {len(pipeline.modes) - 1}"
            )
        observations, told[:, t] = engine.step(actions, scored)
    return program.by_name(names, told)


def evaluate(
    names: Sequence[str],
    source: EpisodeSource,
    radio: str,
    episodes: int,
    seed: int,
    modes: tuple[Mode, ...] | None = None,
) -> dict[str, Scores]:
    """Scores of contenders on the same episodes, seeds ``seed .. seed + episodes - 1``.

    Raises:
        ValueError: unknown or repeated contender, or fewer than one episode.
    """
    require_seeds(range(seed, seed + episodes))
    if len(set(names)) < len(names):
        raise ValueError(f"policies: found {', '.join(names)}, expected no name twice")
    chosen = [contender_from(name, radio, modes) for name in names]
    policies = [contender.start(source.layout) for contender in chosen]
    parts: dict[str, list[Scores]] = {c.name: [] for c in chosen}
    with Progress(transient=True) as progress:
        task = progress.add_task(source.name, total=episodes * (1 + len(chosen)))
        for first in range(0, episodes, CHUNK):
            seeds = range(seed + first, seed + min(first + CHUNK, episodes))
            batch = []
            for one in seeds:
                batch += draw_episodes(source, [one])
                progress.advance(task)
            for contender, policy in zip(chosen, policies, strict=True):
                parts[contender.name].append(score(contender, policy, batch))
                progress.advance(task, len(batch))
    return {
        name: {m: np.concatenate([part[m] for part in scores]) for m in METRICS}
        for name, scores in parts.items()
    }


@dataclass(frozen=True)
class Comparison:
    """Contenders on one source of episodes.

    Attributes:
        scenario, radio, episodes, seed: what was run.
        policies: per contender and metric.
        paired: the same for differences "A - B", episode by episode.
    """

    scenario: str
    radio: str
    episodes: int
    seed: int
    policies: dict[str, dict[str, Interval]]
    paired: dict[str, dict[str, Interval]]

    @property
    def json(self) -> dict[str, Any]:
        """As results files hold it."""

        def table(rows: dict[str, dict[str, Interval]]) -> dict[str, Any]:
            return {k: {m: i.json for m, i in row.items()} for k, row in rows.items()}

        return {
            "scenario": self.scenario, "radio": self.radio, "episodes": self.episodes,
            "seed": self.seed, "policies": table(self.policies), "paired": table(self.paired),
        }  # fmt: skip


def references(scores: dict[str, Scores]) -> list[str]:
    """What others are compared with: best fixed mode by reward, the paper's rule, the IMM."""
    fixed = [name for name in scores if name.startswith("fixed-")]
    best = max(fixed, key=lambda name: scores[name]["reward"].mean(), default=None)
    return [name for name in (best, "speed-rule", "imm") if name is not None and name in scores]


def compare(scores: dict[str, Scores], **what: Any) -> Comparison:
    """Intervals of every contender, and paired differences against the references."""
    metrics = list(METRICS)

    def rows(table: dict[str, Array]) -> dict[str, dict[str, Interval]]:
        intervals = bootstrap(np.concatenate(list(table.values()), axis=1))
        return {
            name: dict(zip(metrics, intervals[i * len(metrics) :], strict=False))
            for i, name in enumerate(table)
        }

    stacked = {name: np.stack([s[m] for m in metrics], axis=1) for name, s in scores.items()}
    pairs = {}
    for reference in references(scores):
        for name in scores:
            if name != reference:
                pairs[f"{name} - {reference}"] = stacked[name] - stacked[reference]
    return Comparison(policies=rows(stacked), paired=rows(pairs) if pairs else {}, **what)
