"""Rivals of the switchers: a particle filter and filters with Student-t or adaptive noise.

`mmwave-loc compare --policies experiments.rivals:particle` plays one of them (docs/rivals.md).
"""

from experiments.rivals.noise import StudentImm as student_imm
from experiments.rivals.noise import Variational as variational
from experiments.rivals.particle import Particles as particle

__all__ = ["particle", "student_imm", "variational"]
