"""Filters: plain functions of numbers, for use with or without an environment.

:class:`Mode` describes a filter. :func:`predict_update` runs a mode for one epoch, and
:func:`~mmwave_env.filters.memory.memory_after` updates the track's memory with the result. ``imm``
mixes the results of several modes, and ``smoother`` smooths a finished track. A filter of your own
(docs/own-filters.md) is a function like :func:`ekf`; import everything that it needs from here.
"""

from mmwave_env.filters.gating import Gate, gate_groups
from mmwave_env.filters.linearization import SigmaPoints, Tangent, linearize
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import Pipeline, predict_update
from mmwave_env.filters.update import Posterior, ckf, ekf, ukf, update
from mmwave_env.models.measurement import groups_of
from mmwave_env.numerics.linalg import dot, symmetric

__all__ = [
    "Gate",
    "Mode",
    "Pipeline",
    "Posterior",
    "SigmaPoints",
    "Tangent",
    "ckf",
    "dot",
    "ekf",
    "gate_groups",
    "groups_of",
    "linearize",
    "predict_update",
    "symmetric",
    "ukf",
    "update",
]
