"""How a switcher is trained: hyperparameters, as small JSON files beside this one hold them."""

from dataclasses import MISSING, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, get_type_hints

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.files import read_json
from mmwave_env.lookup import quoted


@dataclass(frozen=True)
class PpoHyperparameters:
    """Hyperparameters of PPO (Schulman et al. 2017), and what this task adds to it."""

    num_envs: int  # environments stepped at once
    n_steps: int  # epochs of each between two updates
    batch_size: int  # of a gradient step
    n_epochs: int  # passes over what was collected
    # learning_rate, ent_coef: at the start; both fall linearly
    learning_rate: float
    ent_coef: float
    final_fraction: float  # what is left of them at the end
    gamma: float  # discount per epoch
    gae_lambda: float  # of generalized advantage estimation
    clip_range: float  # of the probability ratio
    max_grad_norm: float  # longest gradient
    target_kl: float  # an update stops when the policy has moved further
    hidden: tuple[int, ...]  # neurons of each tanh layer, of the actor and of the critic
    clip_observation: float  # normalized observations lie between minus this and this
    # train on the reward minus that of an IMM on the same episode: its actions change nothing
    # there, so the best policy stays the same and the variance falls
    paired: bool
    # added to the logit of action 0 at the start. Where every mode keeps its own belief, action 0
    # trusts none: learning starts level with the IMM
    first_action_bias: float = 0.0

    algorithm = "ppo"
    together = 1  # environments side by side that have to be at one place: any may be anywhere

    def __post_init__(self) -> None:
        _require_kinds(self)
        _require_least(
            self, num_envs=1, n_steps=1, n_epochs=1,
            batch_size=2,  # one advantage alone can't be normalized
        )  # fmt: skip
        _require_fractions(self, "gamma", "gae_lambda", "final_fraction")


@dataclass(frozen=True)
class RolloutHyperparameters:
    """Hyperparameters of rollout policy iteration (:mod:`experiments.training.rollouts`)."""

    num_envs: int  # environments stepped at once
    horizon: int  # epochs that an action is followed for
    gamma: float  # discount per second
    stride: int  # epochs between two states of an environment in which all actions are tried
    states: int  # in which all actions are tried between two updates, at least
    memory: int  # latest states that an update learns from
    gradient_steps: int  # of an update
    batch_size: int  # states of a gradient step
    # learning_rate, ent_coef: at the start; both fall linearly
    learning_rate: float
    ent_coef: float
    final_fraction: float  # what is left of them at the end
    hidden: tuple[int, ...]  # neurons of each tanh layer
    clip_observation: float  # normalized observations lie between minus this and this
    first_action_bias: float  # logit of action 0 at the start, beside about 0 of the others

    algorithm = "rollouts"
    together = WIDTH  # environments side by side that have to be at one place: they run as lanes

    def __post_init__(self) -> None:
        _require_kinds(self)
        counts = ("num_envs", "horizon", "stride", "states", "gradient_steps", "batch_size")
        _require_least(self, **dict.fromkeys(counts, 1), memory=self.num_envs)
        _require_fractions(self, "gamma", "final_fraction")


Hyperparameters = PpoHyperparameters | RolloutHyperparameters
MOST = 1e15  # of any of them: more is a slip, and too much for memory and time
KINDS: dict[str, type[Hyperparameters]] = {
    kind.algorithm: kind for kind in (PpoHyperparameters, RolloutHyperparameters)
}


def _require_kinds(found: Hyperparameters) -> None:
    """Refuse values of another type than the field's, negative ones and infinite ones."""
    for name, kind in get_type_hints(type(found)).items():
        value = getattr(found, name)
        if kind in (int, float):
            sound = type(value) in {kind, int} and 0 <= value < MOST
            expected = "a number of 0 or more" if kind is float else "a count of 0 or more"
        elif kind is bool:
            sound, expected = type(value) is bool, "true or false"
        else:
            sound = isinstance(value, tuple) and all(type(n) is int and n > 0 for n in value)
            sound, expected = sound and bool(value), "a list of counts of neurons"
        if not sound:
            raise ValueError(f"{name}: found {quoted(value)}, expected {expected}")


def _require_least(found: Hyperparameters, **least: int) -> None:
    for name, bound in least.items():
        if (value := getattr(found, name)) < bound:
            raise ValueError(f"{name}: found {value}, expected {bound} or more")


def _require_fractions(found: Hyperparameters, *names: str) -> None:
    for name in names:
        if (value := getattr(found, name)) > 1:
            raise ValueError(f"{name}: found {value}, expected 0 to 1")


def read_hyperparameters(path: Path, algorithm: str) -> Hyperparameters:
    """Read a hyperparameter file, a JSON object with the attributes of its kind.

    Those with a default may be left out.

    Args:
        path: the file.
        algorithm: one of :data:`KINDS`.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    return read_json(path, "a hyperparameter file", partial(_made, KINDS[algorithm]))


def _made(kind: type[Hyperparameters], found: dict[str, Any]) -> Hyperparameters:
    """Those of a file's object."""
    known = {field.name: field.default is MISSING for field in fields(kind)}
    missing = {name for name, needed in known.items() if needed} - set(found)
    unknown = set(found) - set(known)
    if missing or unknown:
        raise ValueError(
            f"missing {', '.join(sorted(missing)) or 'none'}, "
            f"unknown {', '.join(sorted(unknown)) or 'none'}"
        )
    hidden = found["hidden"]  # JSON has no tuples
    return kind(**found | {"hidden": tuple(hidden) if isinstance(hidden, list) else hidden})


def hyperparameters_as_written(found: Hyperparameters) -> dict[str, Any]:
    """Tell them as a file holds them; what has a default and is as by default is left out."""
    return {
        field.name: list(value) if isinstance(value, tuple) else value
        for field in fields(found)
        if (value := getattr(found, field.name)) != field.default
    }


def shipped_hyperparameters(algorithm: str, beliefs: str = "shared") -> Path:
    """The hyperparameter file of an algorithm, where modes share a belief or keep their own."""
    guided = algorithm == "ppo" and beliefs == "per-mode"
    return Path(__file__).with_name(f"{'guided-' if guided else ''}{algorithm}.json")


def falling(last: float, left: float) -> float:
    """What remains of a rate when a fraction of the training is left.

    The last update may end beyond the training, with less than nothing left: there the rate falls
    on, but stays positive.

    Args:
        last: what remains at the end.
        left: of the training.
    """
    return max(last + (1.0 - last) * left, 0.5 * last)
