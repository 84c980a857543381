"""A data set as inspect sees it, whatever its format: epochs in blocks, anchors, and oddities."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mmwave_env.numerics.arrays import Array, Mask


class Epochs(NamedTuple):
    """T consecutive epochs."""

    time_s: Array  # (T,) increasing
    position_m: Array  # (T, 3) of the user, NaN where not known
    visible: Mask  # (T, L) whether the link to an anchor was measured; (T, 0) without anchors


@dataclass(kw_only=True)
class DataSet:
    """What was recognized, and how to read it.

    Attributes:
        format: in words.
        epochs: read as they are iterated over, so that they may be more than fit into memory.
        positions: where those of the epochs come from, in words.
        are_true: whether they are the truth, so that speeds follow from them.
        timed: whether they follow one another; else times are numbers, and there are no speeds.
        anchors_m: (L, 3), the base station first.
        facts: what else there is to say, by what it is about.
        problems: what is wrong; reading the epochs may add to them.
        damage: what ended the epochs before their end; reading them may set it.
    """

    format: str
    epochs: Iterable[Epochs]
    positions: str
    are_true: bool = True
    timed: bool = True
    anchors_m: Array = field(default_factory=lambda: np.empty((0, 3)))
    facts: dict[str, str] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    damage: ValueError | None = None
