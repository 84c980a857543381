"""Policies that choose a mode per epoch, from the paper's rule to learned switchers."""

from policies.learned import LearnedSwitch, shipped_policies
from policies.policy import Policy
from policies.scripted import FixedMode, LikelihoodRule, RandomMode, SpeedRule
from policies.thresholds import tuned_threshold

__all__ = [
    "FixedMode",
    "LearnedSwitch",
    "LikelihoodRule",
    "Policy",
    "RandomMode",
    "SpeedRule",
    "shipped_policies",
    "tuned_threshold",
]
