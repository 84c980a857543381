"""The begin of a track of a log, to play on a page."""

from collections.abc import Sequence

import numpy as np

from experiments.webpage.episodes import Gates, Place, course, scenery
from experiments.webpage.played import Played
from mmwave_env.filters.bank import Bank
from mmwave_env.filters.belief import Belief
from mmwave_env.filters.modes import Mode
from mmwave_env.filters.pipeline import VERTICAL
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.logs.truth import Truth
from mmwave_env.models.scene import Scene
from mmwave_env.numerics.linalg import unpack


def shown_track(
    name: str, scene: Scene, block: TrackBlock, modes: Sequence[Mode] | Bank, truth: Truth | None
) -> Played:
    """Some epochs of a track, filtered, beside the truth if it is known.

    Args:
        name: of the log.
        scene: of the log.
        block: the epochs.
        modes: that ran, or the bank of an IMM.
        truth: where the user was.
    """
    axes = (0, 1) if block.planar else (0, 1, 2)
    known = np.full((len(block), 3), np.nan)
    if truth:
        known = truth.at(block.time_s).position_m
    zero = VERTICAL if block.planar else ()
    belief = Belief([*block.x.T], unpack([*block.P.T], zero=zero), axes)
    nees = np.asarray(belief.nees([*known.T]))
    place = Place(
        scene.anchors_m, scene.streets if scene.streets_known else None, block.layout, len(axes)
    )
    shown = scenery(name, place, block.time_s, known, np.linalg.norm(block.x[:, 3:6], axis=1))
    gates = Gates(block.accepted, block.visible & ~block.accepted, block.nis)
    error, weighed = block.x[:, :3] - known, isinstance(modes, Bank)
    names = [mode.name for mode in (modes.modes if isinstance(modes, Bank) else modes)]
    shown["contenders"]["track"] = course(
        block.x, block.P, error, nees, gates, names, block.mode, weighed
    )
    return Played(axes=len(axes), shown=[shown])
