"""Policies that choose a mode per epoch, from the paper's rule to learned switchers."""

from policies.imms import TUNED_IMMS, Transition, TunedImm, tuned_imm
from policies.learned import LearnedSwitch, shipped_policies
from policies.policy import Policy
from policies.scripted import FixedMode, LikelihoodRule, RandomMode, SpeedRule

__all__ = [
    "TUNED_IMMS",
    "FixedMode",
    "LearnedSwitch",
    "LikelihoodRule",
    "Policy",
    "RandomMode",
    "SpeedRule",
    "Transition",
    "TunedImm",
    "shipped_policies",
    "tuned_imm",
]
