"""Contenders: a policy with the modes it chooses from, or an IMM; all that have a name."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from experiments.evaluation.agents import GUIDE, Act, agent_from, is_agent, tried
from experiments.evaluation.runs import Run, require_no_smoke
from mmwave_env.filters.bank import Transition
from mmwave_env.filters.mode_files import default_modes, modes_from, named_modes
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline
from mmwave_env.lookup import unknown
from mmwave_env.models.measurement import Layout
from mmwave_env.models.radio import profile_of
from mmwave_env.observation import Observation
from policies import (
    TUNED_IMMS,
    FixedMode,
    LearnedSwitch,
    LikelihoodRule,
    Policy,
    RandomMode,
    SpeedRule,
    shipped_policies,
    tuned_imm,
)

POLICY_SEED = 0
OTHERS = (
    "a .safetensors file", "the folder of a run", "a .zip of Stable-Baselines3", "module:function",
)  # fmt: skip
SHIPPED = ("ppo", "ppo-extended")  # learned contenders of a radio, where its policy is shipped


@dataclass(frozen=True)
class Contender:
    """Something that localizes.

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

    @classmethod
    def own(
        cls,
        name: str,
        agent: Act,
        radio: str,
        modes: Sequence[Mode | str] | str | None = None,
        observation: str = "full",
    ) -> "Contender":
        """An agent of one's own; its attributes ``modes`` and ``observation`` go first.

        Args:
            name: in results.
            agent: from observations (n, features) to actions (n,); see
                :func:`~experiments.evaluation.agents.tried`.
            radio: profile.
            modes: that it chooses from, as of ``MmWaveLoc-v0``; None for the profile's two.
            observation: what it sees, "full" or "prior".
        """
        chosen = modes_from(getattr(agent, "modes", modes), radio)
        observation = getattr(agent, "observation", observation)
        return cls(name, chosen, partial(tried, name, agent), observation=observation, trained=True)

    def start(self, layout: Layout, planar: bool = False) -> Policy | None:
        """A new policy for measurements of a layout; None for the IMM."""
        table = Observation(Pipeline(self.modes, layout, planar), self.observation)
        return self.policy and self.policy(table)


Make = Callable[[], Contender]


def _fixed(name: str, modes: tuple[Mode, ...], action: int) -> Contender:
    return Contender(name, modes, lambda table: FixedMode(action))


def _tuned_imm(name: str, radio: str) -> Contender:
    imm = tuned_imm(name, radio)
    return Contender(name, imm.modes, None, imm.transition, imm.nis_quantile)


def _of_any_modes(modes: tuple[Mode, ...]) -> dict[str, Make]:
    """What works with any modes: each of them alone, rules, chance and the IMM."""
    names = [mode.name for mode in modes]
    found: dict[str, Make] = {
        f"fixed-{name}": partial(_fixed, f"fixed-{name}", modes, i) for i, name in enumerate(names)
    }
    policies: dict[str, Callable[[Observation], Policy]] = {}
    if len(modes) == 2:
        policies["speed-rule"] = SpeedRule
    if len(modes) > 1:
        policies["likelihood-rule"] = lambda table: LikelihoodRule(table, names)
        policies["random"] = lambda table: RandomMode(len(modes), POLICY_SEED)
    found |= {name: partial(Contender, name, modes, policy) for name, policy in policies.items()}
    return found | {"imm": partial(Contender, "imm", modes, None)}


def contenders(radio: str, modes: tuple[Mode, ...] | None = None) -> dict[str, Make]:
    """How to make every contender there is, by name; nothing is read from files before.

    Args:
        radio: profile, a name or a JSON file.
        modes: what they work with; None for the profile's two, beside which the profile has
            single modes of other kinds, tuned IMMs, and the learned switchers that are shipped
            for it.
    """
    if modes is not None:
        return _of_any_modes(modes)
    radio = profile_of(radio)
    named, two = named_modes(radio), default_modes(radio)
    alone = {f"fixed-{name}": (named[name],) for name in ("ckf", "ekf-robust", "ukf-robust")}
    fixed: dict[str, Make] = {n: partial(_fixed, n, mode, 0) for n, mode in alone.items()}
    imms = {name: partial(_tuned_imm, name, radio) for name in TUNED_IMMS}
    shipped = shipped_policies()
    learned = {
        name: partial(Contender.learned, f"{name}-{radio}", name)
        for name in SHIPPED
        if f"{name}-{radio}" in shipped
    }
    ekf, ukf, rule, *rest = _of_any_modes(two).items()
    return dict([ekf, ukf, *fixed.items(), rule, *rest]) | imms | learned


def contender_from(
    name: str,
    radio: str,
    modes: tuple[Mode, ...] | None = None,
    observation: str = "full",
    trust_zip: bool = False,
) -> Contender:
    """A contender by name; see :func:`contenders`.

    Args:
        name: one of them, a shipped policy's, a policy file (``.safetensors``), the folder of a
            run, which stands for its median training, or what
            :func:`~experiments.evaluation.agents.agent_from` takes.
        radio, modes: as of :func:`contenders`.
        observation: of agents of one's own, as of :meth:`Contender.own`.
        trust_zip: whether code from a ``.zip`` may run.

    Raises:
        ValueError: unknown name; the message lists the valid ones. A damaged policy file, or
            an agent that can't be had.
        FileNotFoundError: there is no such file.
    """
    known, shipped = contenders(radio, modes), shipped_policies()
    if name in known:
        return known[name]()
    if name in shipped or name.endswith(".safetensors"):
        require_no_smoke(name, LearnedSwitch(name).card.command)
        return Contender.learned(name)
    if Path(name).is_dir():
        return Contender.learned(Run.read(name).policy, name)
    if is_agent(name):
        return Contender.own(name, agent_from(name, trust_zip), radio, modes, observation)
    stem = name.removesuffix(".py")
    module = f"; {Path(stem).name}:FUNCTION names an agent in a module ({GUIDE})"
    hint = module if Path(f"{stem}.py").is_file() else ""
    raise ValueError(unknown("policy", name, [*known, *shipped, *OTHERS]) + hint)
