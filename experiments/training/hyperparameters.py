"""How a switcher is trained: hyperparameters, as small JSON files beside this one hold them."""

from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.files import read_json
from mmwave_env.records import Bound, Probability, Size, counts, object_from, require_fields

MOST = 10**15  # of any of them: more is a slip, and too much for memory and time
Count = Annotated[int, counts(1, MOST)]
Positive = Annotated[float, Bound(f"a number of 0 to {MOST:g}", least=0.0, most=MOST)]
Neurons = Annotated[tuple[Count, ...], Size(1, 100)]


@dataclass(frozen=True)
class PpoHyperparameters:
    """Hyperparameters of PPO (Schulman et al. 2017), and what this task adds to it."""

    num_envs: Count  # environments stepped at once
    n_steps: Count  # epochs of each between two updates
    batch_size: Annotated[int, counts(2, MOST)]  # one advantage alone can't be normalized
    n_epochs: Count  # passes over what was collected
    # learning_rate, ent_coef: at the start; both fall linearly
    learning_rate: Positive
    ent_coef: Positive
    final_fraction: Probability  # what is left of them at the end
    gamma: Probability  # discount per epoch
    gae_lambda: Probability  # of generalized advantage estimation
    clip_range: Positive  # of the probability ratio
    max_grad_norm: Positive  # longest gradient
    target_kl: Positive  # an update stops when the policy has moved further
    hidden: Neurons  # of each tanh layer, of the actor and of the critic
    clip_observation: Positive  # normalized observations lie between minus this and this
    # train on the reward minus that of an IMM on the same episode: its actions change nothing
    # there, so the best policy stays the same and the variance falls
    paired: bool
    # added to the logit of action 0 at the start. Where every mode keeps its own belief, action 0
    # trusts none: learning starts level with the IMM
    first_action_bias: Positive = 0.0

    algorithm = "ppo"
    together = 1  # environments side by side that have to be at one place: any may be anywhere

    def __post_init__(self) -> None:
        require_fields(self)


@dataclass(frozen=True)
class RolloutHyperparameters:
    """Hyperparameters of rollout policy iteration (:mod:`experiments.training.rollouts`)."""

    num_envs: Count  # environments stepped at once
    horizon: Count  # epochs that an action is followed for
    gamma: Probability  # discount per second
    stride: Count  # epochs between two states of an environment in which all actions are tried
    states: Count  # in which all actions are tried between two updates, at least
    memory: Count  # latest states that an update learns from
    gradient_steps: Count  # of an update
    batch_size: Count  # states of a gradient step
    # learning_rate, ent_coef: at the start; both fall linearly
    learning_rate: Positive
    ent_coef: Positive
    final_fraction: Probability  # what is left of them at the end
    hidden: Neurons  # of each tanh layer
    clip_observation: Positive  # normalized observations lie between minus this and this
    first_action_bias: Positive  # logit of action 0 at the start, beside about 0 of the others

    algorithm = "rollouts"
    together = WIDTH  # environments side by side that have to be at one place: they run as lanes

    def __post_init__(self) -> None:
        require_fields(self)
        if self.memory < self.num_envs:
            raise ValueError(f"memory: found {self.memory}, expected {self.num_envs} or more")


Hyperparameters = PpoHyperparameters | RolloutHyperparameters
KINDS: dict[str, type[Hyperparameters]] = {
    kind.algorithm: kind for kind in (PpoHyperparameters, RolloutHyperparameters)
}


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
    return read_json(path, "a hyperparameter file", partial(object_from, KINDS[algorithm]))


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
