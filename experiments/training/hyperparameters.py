"""Hyperparameters of training runs, and the JSON files that hold them."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

from experiments.console.options import TaskArgs
from mmwave_env.compiler.lanes import WIDTH
from mmwave_env.io.files import read_json
from mmwave_env.io.records import Bound, Name, Probability, Record, Size, counts, object_from

MOST = 10**15  # largest value of a hyperparameter; more would need too much memory and time
Count = Annotated[int, counts(1, MOST)]
NotNegative = Annotated[float, Bound(f"a number from 0 to {MOST:g}", least=0.0, most=MOST)]
Neurons = Annotated[tuple[Count, ...], Size(1, 100)]


@dataclass(frozen=True, kw_only=True)
class Hyperparameters(Record):
    """Hyperparameters of every algorithm."""

    num_envs: Count  # number of environments stepped, or episodes played, at the same time
    batch_size: Count  # epochs (PPO), states (rollouts) or episodes (corrector) per gradient step
    learning_rate: NotNegative  # initial learning rate; it falls linearly
    final_fraction: Probability  # share of learning_rate and ent_coef that is left at the end

    algorithm: ClassVar[str]  # name on the command line
    together: ClassVar[int] = 1  # number of adjacent environments that share a place (scene, radio)


@dataclass(frozen=True, kw_only=True)
class _SwitcherHyperparameters(Hyperparameters):
    """Hyperparameters of the algorithms that train switchers (policies that choose modes)."""

    gamma: Probability  # discount per epoch (PPO) or per second (rollouts)
    ent_coef: NotNegative  # initial weight of the entropy; it falls linearly
    hidden: Neurons  # sizes of the tanh layers; PPO's critic has layers of the same sizes
    clip_observation: NotNegative  # largest absolute value of a normalized observation
    # Initial logit of action 0; the other initial logits are about 0. If every mode keeps its own
    # belief, action 0 leaves the mixing to the IMM; with a large bias, a policy begins as the IMM.
    first_action_bias: NotNegative = 0.0


@dataclass(frozen=True, kw_only=True)
class PpoHyperparameters(_SwitcherHyperparameters):
    """Hyperparameters of PPO (Schulman et al. 2017), and of this project's additions to it."""

    batch_size: Annotated[int, counts(2, MOST)]  # 2 or more, to normalize advantages in a batch
    n_steps: Count  # epochs of each environment between two updates
    n_epochs: Count  # passes over the collected epochs
    gae_lambda: Probability  # lambda of generalized advantage estimation
    clip_range: NotNegative  # clipping range of the probability ratio
    max_grad_norm: NotNegative  # length to which longer gradients are shortened
    target_kl: NotNegative  # an update stops at 1.5 times this KL divergence from the old policy
    # Whether to train on the reward minus the IMM's reward in the same episode. Actions do not
    # change the IMM's reward, so the best policy stays the same, and the variance falls.
    paired: bool

    algorithm = "ppo"


@dataclass(frozen=True, kw_only=True)
class RolloutHyperparameters(_SwitcherHyperparameters):
    """Hyperparameters of rollout policy iteration (:mod:`experiments.training.rollouts`)."""

    horizon: Count  # length of a rollout, epochs
    stride: Count  # epochs of an environment between two states in which all actions are tried
    states: Count  # minimum number of new states per update; all actions are tried in each state
    memory: Count  # number of latest states that an update learns from
    gradient_steps: Count  # number of gradient steps of an update

    algorithm = "rollouts"
    together = WIDTH  # environments in a block of SIMD lanes share a place

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.memory < self.num_envs:
            raise ValueError(f"memory: found {self.memory}, expected {self.num_envs} or more")


@dataclass(frozen=True, kw_only=True)
class CorrectorHyperparameters(Hyperparameters):
    """Hyperparameters of correctors (:mod:`experiments.training.corrector`)."""

    base: str  # policy whose beliefs are corrected: a shipped switcher, or imm-best
    # places that the training does not use; the policy with the best reward there is kept
    judged_at: Annotated[tuple[Name, ...], Size(1, 100)]
    random_share: Probability  # share of episodes whose streets, radio and receiver are random
    long_epochs: Count  # length of long episodes, epochs; they are used only at 5 Hz or more
    # front, units, head: numbers of neurons before, in and after the recurrent layer
    front: Count
    units: Count
    head: Count
    members: Count  # number of members of the ensemble
    likelihood_weight: NotNegative  # weight of the log-likelihood in the loss
    max_grad_norm: NotNegative  # length to which longer gradients are shortened

    algorithm = "corrector"


@dataclass(frozen=True, kw_only=True)
class TwoWayHyperparameters(CorrectorHyperparameters):
    """Hyperparameters of two-way correctors (:mod:`experiments.training.corrector`)."""

    rounds: (
        Count  # number of rounds of episodes to play before learning, half a million epochs each
    )

    algorithm = "two-way"


ALL = (PpoHyperparameters, RolloutHyperparameters, CorrectorHyperparameters, TwoWayHyperparameters)
KINDS: dict[str, type[Hyperparameters]] = {kind.algorithm: kind for kind in ALL}


def read_hyperparameters(path: Path, algorithm: str) -> Hyperparameters:
    """Read the hyperparameters of an algorithm (a key of :data:`KINDS`) from a JSON file.

    Hyperparameters that have a default may be left out.

    Raises:
        ValueError: the file is not valid; the message names the file and the mistake.
        FileNotFoundError: there is no such file.
    """
    return read_json(path, "a hyperparameter file", partial(object_from, KINDS[algorithm]))


def shipped_hyperparameters(algorithm: str, beliefs: str = "shared") -> Path:
    """Return the shipped file for an algorithm, with shared beliefs or beliefs per mode."""
    guided = algorithm == "ppo" and beliefs == "per-mode"
    return Path(__file__).with_name(f"{'guided-' if guided else ''}{algorithm}.json")


def hyperparameters(
    args: TaskArgs, places: int, path: Path | None = None, **changed: Any
) -> Hyperparameters:
    """Read the hyperparameters of a training.

    Args:
        args: options of the task.
        places: number of places to train at.
        path: file of hyperparameters; None for the shipped file.
        changed: hyperparameters to change, by name.

    Raises:
        ValueError: the file is for another algorithm, or its number of environments can't be
            divided among the places.
    """
    path = path or shipped_hyperparameters(args.algo, args.beliefs)
    hyper = replace(read_hyperparameters(path, args.algo), **changed)
    together = hyper.together
    if hyper.num_envs % together or hyper.num_envs < together * places:
        multiple = f"a multiple of {together}, " if together > 1 else ""
        raise ValueError(
            f"{path}: num_envs: found {hyper.num_envs}, expected {multiple}{together * places} or "
            f"more for {places} places"
        )
    return hyper


def falling(last: float, left: float) -> float:
    """Return the share of a rate that remains when a fraction of the training is left.

    The last update may end after the planned end of the training. The fraction is then negative,
    and the rate falls further, but stays positive.

    Args:
        last: share of the rate at the end.
        left: fraction of the training that is left.
    """
    return max(last + (1.0 - last) * left, 0.5 * last)
