"""Options of mmwave-loc evaluate."""

from dataclasses import dataclass

from experiments.arguments.shared import EpisodeArgs


@dataclass(kw_only=True)
class Args(EpisodeArgs):
    """Evaluate one policy on seeded episodes.

    All figures, the reward too, leave out the first 10 epochs of an episode.

    mmwave-loc evaluate --policy ppo --scenario vehicle --episodes 200
    """

    policy: str = "speed-rule"
    """a name of mmwave-loc list policies, a policy file (.safetensors), the folder of a run, a
    model of Stable-Baselines3 (.zip, with --trust-zip), or module:function, a function without
    arguments that returns an agent"""
