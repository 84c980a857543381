"""Contenders by name (IMMs, and policies with their modes); tasks and episodes from options."""

import hashlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.console.options import ModeArgs, WorldArgs
from experiments.console.output import grid
from experiments.evaluation.agents import (
    GUIDE,
    Act,
    Checked,
    Estimator,
    agent_from,
    blaming,
    is_agent,
    module_file,
)
from experiments.evaluation.branches import CLAIRVOYANT, Clairvoyant
from experiments.evaluation.intervals import Interval
from mmwave_env import __version__
from mmwave_env.filters.bank import (
    Bank,
    Modes,
    bank_from,
    bank_over,
    best_bank,
    default_modes,
    named_modes,
)
from mmwave_env.filters.modes import Mode
from mmwave_env.interface.actions import MODE
from mmwave_env.interface.observation import Observation
from mmwave_env.interface.policy import FixedMode, Policy, Switching, policy_from
from mmwave_env.io.files import AnyPath, Json, read_json
from mmwave_env.io.lookup import unknown
from mmwave_env.models.radio import radio_from
from mmwave_env.task import Task, TaskArguments, bank_and_modes, task_from
from mmwave_env.world.episode import Episode, EpisodeSource
from mmwave_env.world.keys import Keys, keys_of
from mmwave_env.world.simulated import SimulatedSource
from policies import LikelihoodRule, SpeedRule, load, shipped_policies
from policies.learned import LearnedPolicy
from policies.policy_file import PolicyFile

BEST_IMM = "imm-best"  # the IMM with the modes of best_bank
RULE = "speed-rule"  # the paper's rule
OTHERS = ("a .safetensors file", "the folder of a run", "module:function, without folder and .py")
# Learned contenders; their shipped policy files are for one radio (NAME-RADIO) or for all (NAME).
SHIPPED = ("ppo", "guided", "guided-ppo", "corrector")

DESCRIPTIONS = {
    "speed-rule": "the paper's rule: EKF up to 2 m/s, UKF above",
    "likelihood-rule": "chooses the mode that explains recent measurements best",
    "imm": "interacting multiple models: mixes all modes instead of choosing one",
    "imm-best": "tuned IMM of modes for users who stand, cruise, turn, accelerate or brake",
    "ppo": "learned policy that chooses between the profile's two modes",
    "guided": "learned policy that raises the probability of one mode of imm-best, or of none",
    "corrector": "the policy guided, with a recurrent network that corrects the positions",
    "guided-ppo": "same as guided, but trained only with PPO",
    "clairvoyant": "knows the truth: a ceiling for policies that choose modes; runs only if named",
}


@dataclass(frozen=True)
class Run:
    """A run of ``mmwave-loc train``, with one policy per training seed.

    Attributes:
        policies: policy files of all seeds, the best reward on tuning seeds first.
        policy: the file with the median reward, which represents the run.
    """

    policies: tuple[str, ...]
    policy: str

    @classmethod
    def read(cls, name: str) -> "Run":
        """Read the run in a folder.

        Raises:
            ValueError: the summary is invalid; the message names the file and what is wrong in it.
            FileNotFoundError: the folder holds no finished run.
        """
        folder = Path(name)
        path = folder / "summary.json"
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: found no file, expected the summary of a finished run; "
                "mmwave-loc train --resume continues an unfinished run"
            )

        def made(summary: Json) -> Run:
            seeds = [outcome["seed"] for outcome in summary["seeds"]]
            median = summary["median"]
            files = {seed: str(folder / f"seed-{seed}" / "policy.safetensors") for seed in seeds}
            if len(files) < len(seeds) or median not in files:
                raise ValueError(
                    f"seeds, median: found {seeds}, {median!r}, expected different numbers, and "
                    "one of them"
                )
            return cls((*files.values(),), files[median])

        return read_json(path, "the summary of a run", made)


def outcomes_markdown(outcomes: Sequence[Json]) -> str:
    """Return a Markdown table of training outcomes, one row per seed, in the given order."""
    minus = [key for key in outcomes[0]["best"] if key.startswith("minus ")]
    rows = [
        [
            outcome["seed"],
            f"{outcome['best']['reward']:.4f}",
            outcome["best"]["timesteps"],
            *(Interval.of(outcome["best"][name]) for name in minus),
            f"{outcome['seconds']:g} s",
        ]
        for outcome in outcomes
    ]
    return grid(["seed", "reward", "best after", *minus, "time"], rows)


@dataclass(frozen=True, kw_only=True)
class Contender(Switching):
    """A policy with its modes, or an IMM, by a name.

    Attributes:
        name: name on the command line and in results.
    """

    name: str

    @classmethod
    def learned(cls, path: AnyPath | PolicyFile, name: str, radio: str) -> "Contender":
        """Return a contender for the learned policy in a file, or for a shipped policy by name.

        A policy that has a bank for each radio uses the bank for ``radio``.
        """
        return cls(**vars(load(path, radio)), name=name)

    @classmethod
    def own(
        cls,
        name: str,
        agent: Act,
        radio: str,
        modes: Modes = None,
        observation: str = "full",
        beliefs: str = "shared",
    ) -> "Contender":
        """Return a contender for a user's agent, a function from observations to actions (n,).

        If ``modes`` is None, the agent gets the radio profile's default modes. The agent's own
        attributes ``modes``, ``observation`` and ``beliefs`` override the arguments. If beliefs are
        "per-mode", the agent's method ``bank(radio)`` overrides ``modes``, too.

        Raises:
            ValueError: modes or beliefs are unknown; the message lists the valid names.
        """
        policy = policy_from(agent, f"policy {name}")
        beliefs = getattr(agent, "beliefs", beliefs)
        modes = getattr(agent, "modes", modes)
        if beliefs == "per-mode" and hasattr(agent, "bank"):
            with blaming(name, f"; it was asked for its bank for the radio {radio} ({GUIDE})"):
                modes = agent.bank(radio)
        bank, chosen = bank_and_modes(modes, beliefs, radio)
        if policy.action != MODE and not bank:
            raise ValueError(
                f"policy {name}: found actions of the kind {policy.action}, which need "
                'beliefs="per-mode"'
            )

        def start(table: Observation) -> Policy:
            if isinstance(agent, LearnedPolicy):
                agent.read_from(table)
            return policy if isinstance(policy, Estimator) else Checked(name, policy, table)

        return cls(
            bank or chosen,
            policy=start,
            observation=getattr(agent, "observation", observation),
            name=name,
        )


Make = Callable[[], Contender]


def contenders(radio: str, modes: Modes = None) -> dict[str, Make]:
    """Return functions that make the contenders, by name; they read files only when called.

    Args:
        radio: radio profile, a name or a JSON file.
        modes: modes of the contenders, as in ``MmWaveLoc-v0``; a bank or a mode file also sets
            the IMM's transition probabilities and NIS quantile. If None, the modes are the
            profile's EKF and UKF, and three kinds of contenders are added: the CKF, the IMM of the
            profile's best bank, and the learned policies that are shipped for the profile.
    """
    bank = Bank(default_modes(radio)) if modes is None else bank_over(modes, radio)
    names = [mode.name for mode in bank.modes]
    makes: dict[str, Make] = {}

    def add(name: str, filters: Any, policy: Any = None) -> None:
        makes[name] = partial(Contender, filters, policy=policy, name=name)

    for i, name in enumerate(names):
        add(f"fixed-{name}", bank.modes, lambda table, i=i: FixedMode(i))
    if modes is None:
        add("fixed-ckf", (named_modes(radio)["ckf"],), lambda table: FixedMode(0))
    if len(names) == 2:
        add(RULE, bank.modes, SpeedRule)
    if len(names) > 1:
        add("likelihood-rule", bank.modes, lambda table: LikelihoodRule(table, names))
    add("imm", bank)
    if modes is not None:
        return makes
    makes[BEST_IMM] = lambda: Contender(best_bank(radio), name=BEST_IMM)
    shipped = shipped_policies()
    base = radio_from(radio).base
    return makes | {
        name: partial(Contender.learned, file, name, radio)
        for name in SHIPPED
        for file in (name, f"{name}-{base}")
        if file in shipped
    }


def contender_from(
    name: str, radio: str, modes: Modes = None, observation: str = "full", beliefs: str = "shared"
) -> Contender:
    """Return a contender by name; see :func:`contenders`.

    Args:
        name: name of a contender or shipped policy, "clairvoyant" (which knows the truth and is
            a ceiling for policies that choose modes), a policy file (``.safetensors``), the folder
            of a run (the policy with the median reward is used), or module:function, as in
            :func:`~experiments.evaluation.agents.agent_from`.
        radio, modes: same as in :func:`contenders`.
        observation, beliefs: settings of a user's agent, as in :meth:`Contender.own`.

    Raises:
        ValueError: the name is unknown (the message lists the valid names), a policy file is
            damaged, or an agent can't be loaded.
        FileNotFoundError: there is no such file.
    """
    known = contenders(radio, modes)
    if name in known:
        return known[name]()
    if name == CLAIRVOYANT:
        return Contender(bank_from(modes, radio), policy=lambda table: Clairvoyant(), name=name)
    if file := _policy_file(name):
        return Contender.learned(file, name, radio)
    if is_agent(name):
        return Contender.own(name, agent_from(name), radio, modes, observation, beliefs)
    if name.endswith(".zip"):
        raise ValueError(
            f"{name}: found a model of Stable-Baselines3, expected a policy file; "
            f"policies.save_sb3(model, path) writes one ({GUIDE})"
        )
    # A dict drops repeated names: some shipped policies are also among the known contenders.
    everything = dict.fromkeys([*known, *shipped_policies(), CLAIRVOYANT, *OTHERS])
    raise ValueError(unknown("policy", name, everything))


def _policy_file(name: str) -> Path | None:
    """Return the policy file of a shipped policy, a file's path or a run; None for other names."""
    shipped = shipped_policies()
    if name in shipped:
        return shipped[name]
    if Path(name).is_dir():
        return Path(Run.read(name).policy)
    return Path(name) if name.endswith(".safetensors") else None


def fingerprint(name: str) -> str:
    """Return the SHA-256 of the file of a contender: a policy file, or the module of an agent.

    The contenders of the package that have no file are known by its version.

    Raises:
        ValueError, FileNotFoundError: there is no such file.
    """
    path = _policy_file(name) or (module_file(name) if is_agent(name) else None)
    if path is None:
        return f"mmwave-loc {__version__}"
    return hashlib.sha256(path.read_bytes()).hexdigest()


def contender_of(args: ModeArgs, name: str) -> Contender:
    """Return a contender by name or file; warn if it ignores the chosen modes."""
    radio = args.radio
    modes = args.modes or None
    contender = contender_from(name, radio, modes, args.observation, args.beliefs)
    if modes and contender.modes != bank_over(modes, radio).modes:
        warnings.warn(f"{name} brings its own modes; --modes does not apply to it", stacklevel=2)
    return contender


def task_of(args: ModeArgs) -> Task:
    """Return the task of an environment that gets these options as its arguments."""
    return _task(args, args.modes or None)


def source_of(args: WorldArgs) -> EpisodeSource:
    """Return the source of the episodes that options describe."""
    # Filters do not matter here; a dummy mode avoids the warning about untuned modes.
    return _task(args, [Mode("none")]).source


def _task(args: WorldArgs, modes: Modes) -> Task:
    names = {field.name for field in fields(TaskArguments)} - {"episodes", "modes"}
    world = {name: value for name, value in vars(args).items() if name in names}
    return task_from(**world, episodes=args.data, modes=modes)


def seeds_from(episodes: int, seed: int) -> range:
    """Return the seeds that a user asked for.

    Raises:
        ValueError: there are no seeds, or a seed is negative.
    """
    if episodes < 1:
        raise ValueError(f"episodes: found {episodes}, expected at least 1")
    if seed < 0:
        raise ValueError(f"seed: found {seed}, expected 0 or more")
    return range(seed, seed + episodes)


def named(seeds: Sequence[int]) -> str:
    """Return the number of episodes and their seeds in words."""
    if len(seeds) == 1:
        return f"1 episode, seed {seeds[0]}, too few for intervals"
    return f"{len(seeds)} episodes, seeds {seeds[0]} and up"


def keys_for(source: EpisodeSource, seeds: Sequence[int]) -> Keys | None:
    """Return the keys (n,) that determine simulated episodes; None for other episodes."""
    return keys_of(seeds) if type(source) is SimulatedSource else None


def draw_episodes(source: EpisodeSource, seeds: Sequence[int]) -> list[Episode]:
    """Draw one episode per seed; ``env.reset(seed=...)`` draws the same episodes."""
    if type(source) is SimulatedSource:
        return source.episodes(keys_of(seeds))
    return [source.sample(np.random.default_rng(seed)) for seed in seeds]
