"""Policies, which choose a mode (a filter) in every epoch: simple rules and learned policies."""

from mmwave_env.interface.policy import Correction, FixedMode, Policy
from policies.corrector import Corrector, load
from policies.learned import LearnedSwitch, shipped_policies
from policies.rules import LikelihoodRule, SpeedRule
from policies.sb3 import save_sb3

__all__ = [
    "Correction",
    "Corrector",
    "FixedMode",
    "LearnedSwitch",
    "LikelihoodRule",
    "Policy",
    "SpeedRule",
    "load",
    "save_sb3",
    "shipped_policies",
]
