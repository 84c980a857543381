"""Rivals of learned policies, for ``--policies experiments.rivals:NAME`` (docs/rivals.md)."""

from experiments.rivals.noise import StudentImm as student_imm
from experiments.rivals.noise import Variational as variational
from experiments.rivals.particle import Particles as particle

__all__ = ["particle", "student_imm", "variational"]
