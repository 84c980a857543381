"""The first epochs of a log's track, localized again for the player of the web page."""

import numpy as np

from experiments.reporting.log_results import beginning
from experiments.reporting.webpage.played import LONGEST, Played, arguments_of, course, scenery
from experiments.reporting.webpage.sources import Source
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.numerics.linalg import unpack


def localized(source: Source) -> Played:
    """Localize the first epochs of a log again for the player, or say why that failed."""
    try:
        args = arguments_of(source)
        block, work = beginning(args, LONGEST)
    except (ValueError, OSError) as error:
        return Played(missing={"": str(error)})
    axes = (0, 1) if block.planar else (0, 1, 2)
    known = np.full((len(block), 3), np.nan)
    if work.truth:
        known = work.truth.at(block.time_s).position_m
    zero = VERTICAL if block.planar else ()
    belief = Belief([*block.x.T], unpack([*block.P.T], zero=zero), axes)
    told = {
        "x": block.x,
        "P": block.P,
        "error": block.x[:, :3] - known,
        "nees": np.asarray(belief.nees([*known.T])),
        "memory.mode": block.mode,
        "memory.nis": block.nis,
        "memory.accepted": block.accepted,
        "memory.rejected": block.visible & ~block.accepted,
    }
    scene, speed_mps = work.scene, np.linalg.norm(block.x[:, 3:6], axis=1)
    streets = scene.streets if scene.streets_known else None
    truth = np.column_stack([block.time_s, known, speed_mps])
    name = source.content["log"]
    shown = scenery(name, block.layout, scene.anchors_m, streets, len(axes), truth)
    weighed = isinstance(work.plan.modes, Bank)
    shown["contenders"]["track"] = course(told, work.plan.names, weighed)
    return Played(shown=[shown])
