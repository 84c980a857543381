"""Colors of lines and areas, told apart by color-blind people, too (Okabe and Ito 2008)."""

from collections.abc import Sequence
from typing import Any

from mmwave_env.numerics.arrays import Array

COLORS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#f0e442", "#666666",
)  # fmt: skip
_NONE = "#e0e0e0"  # of choosing no mode


def draw_shares(axes: Any, time_s: Array, shares: Array, names: Sequence[str]) -> None:
    """Shares (k, w) that add up to 1, one upon the other, over times (w,) around an event.

    A mode has the same color whether there is "none" beside it or not.
    """
    modes = len([name for name in names if name != "none"])
    repeated = COLORS * (1 + modes // len(COLORS))
    colors = [*([_NONE] * (len(names) - modes)), *repeated[:modes]]
    axes.stackplot(time_s, shares, labels=names, colors=colors, edgecolor="white", lw=0.4)
    axes.axvline(0.0, color="black", lw=0.8)
    axes.set_ylim(0.0, 1.0)
    axes.margins(x=0.0)
