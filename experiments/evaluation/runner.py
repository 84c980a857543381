"""Run contenders on the same episodes (design: evaluation protocol).

A contender is a policy with the modes it chooses from, or the IMM.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from mmwave_env.compiler.program import rows_of
from mmwave_env.engines.env_engine import Engine
from mmwave_env.engines.imm_engine import ImmEngine
from mmwave_env.episodes.episode import Episode, EpisodeSource
from mmwave_env.filters.mode_files import default_modes, named_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.metrics import METRICS, summary
from mmwave_env.models.measurement import Layout
from mmwave_env.observation import Observation
from mmwave_env.reward import Reward, TrackingReward
from policies import (
    TUNED_IMMS,
    FixedMode,
    LearnedSwitch,
    LikelihoodRule,
    Policy,
    RandomMode,
    SpeedRule,
    Transition,
    shipped_policies,
    tuned_imm,
    tuned_threshold,
)

Array = NDArray[np.float64]
Scores = dict[str, Array]  # metric -> (episodes,)

Told = dict[str, NDArray[Any]]  # "reward", "nees" (n, T), "error" (n, T, 3); policies': "mode"

CHUNK = 1000  # episodes in memory at once
POLICY_SEED = 0
SHIPPED = ("ppo", "ppo-extended")  # learned contenders of a radio, where its policy is shipped


@dataclass(frozen=True)
class Contender:
    """Something that localises.

    Attributes:
        name: as on the command line and in results.
        modes: what it works with.
        policy: from the observation table to a policy; None for the IMM over the modes.
        transition, nis_quantile: as of :class:`~mmwave_env.engines.imm_engine.ImmEngine`.
        observation: what the policy sees, "full" or "prior".
        trained: whether the policy was learned.
    """

    name: str
    modes: tuple[Mode, ...]
    policy: Callable[[Observation], Policy] | None
    transition: Transition | None = None
    nis_quantile: float = 1.0
    observation: str = "full"
    trained: bool = False

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
            trained=True,
        )

    def start(self, layout: Layout) -> Policy | None:
        """A new policy for measurements of a layout; None for the IMM."""
        table = Observation(Pipeline(self.modes, layout), self.observation)
        return self.policy and self.policy(table)


Watch = Callable[[Contender, Sequence[Episode], Told], None]


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
            single modes of other kinds, a tuned threshold, tuned IMMs, and the learned
            switchers that are shipped for it.
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
    imms = []
    for name in TUNED_IMMS:
        imm = tuned_imm(name, radio)
        imms.append(Contender(name, imm.modes, None, imm.transition, imm.nis_quantile))
    files = {name: f"{name}-{radio}" for name in SHIPPED}
    shipped = shipped_policies()
    learned = [Contender.learned(f, name) for name, f in files.items() if f in shipped]
    ekf, ukf, rule, *rest = _over(two)
    return {c.name: c for c in (ekf, ukf, *others, rule, tuned, *rest, *imms, *learned)}


def contender_from(name: str, radio: str, modes: tuple[Mode, ...] | None = None) -> Contender:
    """A contender by name; see :func:`contenders`.

    Args:
        name: one of them, a shipped policy's, or a policy file (``.safetensors``).
        radio, modes: as of :func:`contenders`.

    Raises:
        ValueError: unknown name; the message lists the valid ones. A damaged policy file.
        FileNotFoundError: there is no such policy file.
    """
    known, shipped = contenders(radio, modes), shipped_policies()
    if name in known:
        return known[name]
    if name in shipped or name.endswith(".safetensors"):
        return Contender.learned(name)
    expected = ", ".join([*known, *shipped, "a .safetensors file", "the folder of a run"])
    raise ValueError(f"policy: found {name!r}, expected one of {expected}")


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
    return _summary(localise(contender, policy, episodes, reward), episodes)


def localise(
    contender: Contender,
    policy: Policy | None,
    episodes: Sequence[Episode],
    reward: Reward | None = None,
) -> Told:
    """What a contender and its policy tell of every epoch, on episodes of one length.

    Returns:
        "reward" and "nees" (n, T), "error" (n, T, 3) in m and, where there is a policy, "mode"
        (n, T), the numbers of its choices.
    """
    reward = reward or TrackingReward()
    for episode in episodes:
        episode.require_truth()
    pipeline = Pipeline(contender.modes, episodes[0].layout)
    if policy is None:
        imm = ImmEngine(pipeline, reward, contender.transition, contender.nis_quantile)
        return imm.run(episodes, "reward", "nees", "error")
    return _steered(pipeline, policy, contender, episodes, reward)


def step_s(episode: Episode) -> float:
    """Time between two epochs, s; of an episode of one epoch, 1."""
    return float(np.median(np.diff(episode.time_s))) if len(episode) > 1 else 1.0


def _summary(told: Told, episodes: Sequence[Episode]) -> Scores:
    return summary(told["reward"], told["error"], told["nees"], 1.0 / step_s(episodes[0]))


def _steered(
    pipeline: Pipeline,
    policy: Policy,
    contender: Contender,
    episodes: Sequence[Episode],
    reward: Reward,
) -> Told:
    """As :func:`localise`, where a policy picks the modes."""
    n, T = len(episodes), len(episodes[0])
    engine = Engine(pipeline, n, reward, contender.observation)
    engine.reset(episodes)
    policy.reset(np.ones(n, bool))
    program, names = engine.batch.program, ("reward", "nees", "error")
    scored = rows_of(program.parts(names))
    told, modes = np.empty((n, T, len(scored))), np.empty((n, T), np.int8)
    observations = engine.observations()
    for t in range(T):
        actions = policy(observations)
        if actions.min() < 0 or actions.max() >= len(pipeline.modes):
            raise ValueError(
                f"actions of {contender.name}: found {actions.min()} to {actions.max()}, "
                f"expected 0 to {len(pipeline.modes) - 1}"
            )
        observations, told[:, t] = engine.step(actions, scored)
        modes[:, t] = actions
    return program.by_name(names, told) | {"mode": modes}


def evaluate(
    names: Sequence[str],
    source: EpisodeSource,
    radio: str,
    episodes: int,
    seed: int,
    modes: tuple[Mode, ...] | None = None,
    watch: Watch | None = None,
) -> dict[str, Scores]:
    """Scores of contenders on the same episodes, seeds ``seed .. seed + episodes - 1``.

    Args:
        names: see :func:`contender_from`.
        source: of the episodes.
        radio: profile.
        episodes: how many.
        seed: of the first.
        modes: as of :func:`contenders`.
        watch: gets every contender, episodes, and what :func:`localise` tells of them.

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
                told = localise(contender, policy, batch)
                parts[contender.name].append(_summary(told, batch))
                if watch:
                    watch(contender, batch, told)
                progress.advance(task, len(batch))
    return {
        name: {m: np.concatenate([part[m] for part in scores]) for m in METRICS}
        for name, scores in parts.items()
    }
