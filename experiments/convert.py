"""mmwave-loc convert: a Stable-Baselines3 model, converted to a policy file that holds no code."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from experiments.console.options import LearnedArgs

if TYPE_CHECKING:
    from mmwave_env.interface.observation import Observation
    from mmwave_env.task import Task
    from policies.policy_file import Card, Tensors


@dataclass(kw_only=True)
class Args(LearnedArgs):
    """Make a policy file from a model of Stable-Baselines3.

    Loading a model runs code from its file, in a separate process that is not a sandbox: convert
    only models that you trust. The policy file holds no code, and needs no PyTorch.

    mmwave-loc convert model.zip policy.safetensors --normalize normalize.pkl
    """

    model: Positional[Path]
    """file that model.save of PPO, A2C, TRPO or MaskablePPO wrote (.zip)"""
    policy: Positional[Path]
    """file to write (.safetensors)"""
    normalize: Path | None = None
    """file that VecNormalize.save wrote, if the training used VecNormalize; loading it runs code"""
    radio: str = "handset"
    """radio profile that the model was trained with: handset, standard, high or a JSON file"""


TIES = 0.001  # maximum fraction of observations on which rounding may change the action


def main(args: Args) -> None:
    """Run the command."""
    from experiments.console.progress import say
    from experiments.training.unzip import CHOSEN, SHOWN, unzipped
    from mmwave_env.interface.observation import Observation
    from mmwave_env.io.files import atomic_path, require_writable
    from mmwave_env.task import task_from
    from policies import LearnedSwitch
    from policies.policy_file import to_bytes

    for path, ending in ((args.model, ".zip"), (args.policy, ".safetensors")):
        if path.suffix != ending:
            raise ValueError(f"found {path}, expected a name that ends with {ending}")
    require_writable(args.policy)
    task = task_from(
        scenario=args.scenario, radio=args.radio, modes=args.modes or None, beliefs=args.beliefs
    )
    table = Observation(task.pipeline, args.observation, args.beliefs)
    tensors, facts = unzipped(args.model, args.normalize)
    shown = tensors.pop(SHOWN)
    chosen = tensors.pop(CHOSEN)
    _require_trained_on(args, table, tensors)
    with atomic_path(args.policy) as temporary:
        temporary.write_bytes(to_bytes(tensors, _card(args, task, table, facts)))
        alike = LearnedSwitch(temporary)(shown) == chosen
        if alike.mean() < 1.0 - TIES:
            raise ValueError(
                f"{args.model}: its layers alone choose the same action as the model for "
                f"{alike.sum()} of {alike.size} observations, expected all; the model does more "
                "than apply layers"
            )
    say(
        f"{args.policy}: same actions as {args.model} on {alike.sum()} of {alike.size} "
        f"observations; next: mmwave-loc compare --policies {args.policy} speed-rule imm"
    )


def _require_trained_on(args: Args, table: "Observation", tensors: "Tensors") -> None:
    """Refuse a model whose observations or number of actions do not match the options."""
    import numpy as np

    last = sum(name.endswith(".bias") for name in tensors) - 1
    actions = len(tensors[f"layer.{last}.bias"])
    sizes = [(len(tensors["low"]), actions), (len(table), len(table.actions))]
    trained, expected = (f"{n} features and {m} actions" for n, m in sizes)
    if trained != expected:
        raise ValueError(
            f"{args.model}: found {trained}, expected {expected}, as with {table.made_with}; give "
            "--observation, --beliefs and --modes as in its training"
        )
    bounds = np.array([tensors["low"], tensors["high"]])
    if args.normalize is None and not np.array_equal(bounds, [table.space.low, table.space.high]):
        raise ValueError(
            f"{args.model}: found observations with other bounds, expected the bounds of this "
            "version of mmwave-loc; train the model again"
        )


def _card(args: Args, task: "Task", table: "Observation", facts: dict[str, Any]) -> "Card":
    from experiments.console.provenance import command_line, versions_of
    from policies.policy_file import Card

    return Card(
        modes=table.modes,
        observation=table.kind,
        features=table.columns,
        scenario=args.scenario,
        radio=args.radio,
        algorithm=facts["network"],
        seed=-1 if facts["seed"] is None else facts["seed"],
        timesteps=facts["timesteps"],
        command=command_line("convert", args),
        evaluation={},
        versions=versions_of("gymnasium", "numpy", "torch", "stable-baselines3"),
        beliefs=table.beliefs,
        banks={task.radio.name: task.bank} if task.bank else {},
    )
