"""Policies that choose a mode per epoch, from the paper's rule to learned switchers."""

from policies.baselines import FixedMode, LikelihoodRule, RandomMode
from policies.learned import LearnedSwitch, shipped_policies
from policies.policy import Policy
from policies.speed_rule import SpeedRule
from policies.tuned_imms import TUNED_IMMS, tuned_imm

__all__ = [
    "TUNED_IMMS",
    "FixedMode",
    "LearnedSwitch",
    "LikelihoodRule",
    "Policy",
    "RandomMode",
    "SpeedRule",
    "shipped_policies",
    "tuned_imm",
]
