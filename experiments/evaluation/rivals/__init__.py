"""Rivals of learned policies (docs/rivals.md).

Name one as ``--policies experiments.evaluation.rivals:NAME``.
"""

from experiments.evaluation.rivals.noise import StudentImm as student_imm
from experiments.evaluation.rivals.noise import Variational as variational
from experiments.evaluation.rivals.particle import Particles as particle

__all__ = ["particle", "student_imm", "variational"]
