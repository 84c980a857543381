"""Options of mmwave-loc doctor."""

from dataclasses import dataclass

from experiments.arguments.shared import JsonArgs


@dataclass(kw_only=True)
class Args(JsonArgs):
    """Is all well here? Versions, threads, compiled functions on disk, a self-test, extras.

    The self-test holds every kernel beside independent twins: the same equations on floats,
    filterpy's filters, numpy. Ends with 1 where one of them differs.

    mmwave-loc doctor
    """
