"""How a switcher is trained: hyperparameters, as small JSON files beside this one hold them."""

import json
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints


@dataclass(frozen=True)
class Hyperparameters:
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
    lstm: int  # neurons of the memory that comes first; 0 for none
    frames: int  # observations that the networks see at once
    clip_observation: float  # normalized observations lie between minus this and this
    # train on the reward minus that of an IMM on the same episode: its actions change nothing
    # there, so the best policy stays the same and the variance falls
    paired: bool
    truth_critic: bool  # the critic, which is not needed after training, also sees the truth
    # added to the logit of action 0 at the start. Where every mode keeps its own belief, action 0
    # trusts none: learning starts level with the IMM
    first_action_bias: float = 0.0

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(Hyperparameters).items():
            value = getattr(self, name)
            if kind in (int, float):
                sound = type(value) in {kind, int} and 0 <= value < float("inf")
                expected = "a number of 0 or more" if kind is float else "a count of 0 or more"
            elif kind is bool:
                sound, expected = type(value) is bool, "true or false"
            else:
                sound = isinstance(value, tuple) and all(type(n) is int and n > 0 for n in value)
                sound, expected = sound and bool(value), "a list of counts of neurons"
            if not sound:
                raise ValueError(f"{name}: found {value!r}, expected {expected}")
        for name, least in (
            ("num_envs", 1), ("n_steps", 1), ("n_epochs", 1), ("frames", 1),
            ("batch_size", 2),  # one advantage alone can't be normalized
        ):  # fmt: skip
            if getattr(self, name) < least:
                found = getattr(self, name)
                raise ValueError(f"{name}: found {found}, expected {least} or more")
        for name in ("gamma", "gae_lambda", "final_fraction"):
            if getattr(self, name) > 1:
                raise ValueError(f"{name}: found {getattr(self, name)}, expected 0 to 1")
        if self.truth_critic and (self.lstm or self.frames > 1):
            raise ValueError("truth_critic: found true, expected false beside lstm or frames")


def read_hyperparameters(path: Path) -> Hyperparameters:
    """The recipe of a hyperparameter file, a JSON object with the attributes of `Hyperparameters`.

    Those with a default may be left out.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected an object")
        known = {field.name: field.default is MISSING for field in fields(Hyperparameters)}
        missing = {name for name, needed in known.items() if needed} - set(found)
        unknown = set(found) - set(known)
        if missing or unknown:
            raise ValueError(
                f"missing {', '.join(sorted(missing)) or 'none'}, "
                f"unknown {', '.join(sorted(unknown)) or 'none'}"
            )
        if isinstance(found["hidden"], list):  # JSON has no tuples
            found["hidden"] = tuple(found["hidden"])
        return Hyperparameters(**found)
    except ValueError as error:
        raise ValueError(f"{path}: not a hyperparameter file: {error}") from error


def recipe_as_written(recipe: Hyperparameters) -> dict[str, Any]:
    """A recipe as its file holds it; what has a default and is as by default is left out."""
    return {
        field.name: list(value) if isinstance(value, tuple) else value
        for field in fields(Hyperparameters)
        if (value := getattr(recipe, field.name)) != field.default
    }


def shipped_hyperparameters(algorithm: str, beliefs: str = "shared") -> Path:
    """The hyperparameter file of an algorithm, where modes share a belief or keep their own."""
    guided = algorithm == "ppo" and beliefs == "per-mode"
    return Path(__file__).with_name(f"{'guided-' if guided else ''}{algorithm}.json")
