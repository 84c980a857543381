"""Figure docs/angles.png of the angle conventions in docs/data.md, drawn by `make generated`."""

from pathlib import Path
from typing import Any

import numpy as np

from experiments.reporting.figures import picture
from mmwave_env.models.layout import Layout
from mmwave_env.models.measurement import exact_rows
from mmwave_env.models.scene import Scene, Wall
from mmwave_env.numerics.numbers import Array

SCENE = Scene("figure", base_station_m=(0.0, 0.0, 10.0), walls=(Wall((0.0, 1.0), 14.0),))
USER_M = (30.0, 9.0, 1.5)
_ANCHOR = "C0"
_USER = "C5"
_MUTED = "C7"
_WIDTH_M = (-6.0, 52.0)


def angles_deg() -> Array:
    """Return the azimuth, elevation and departure angles (n, 3) of the links in the scene."""
    layout = Layout(len(SCENE.anchors_m))
    rows = exact_rows(USER_M, [0.0] * 3, SCENE.anchors_m.tolist(), SCENE.hz_per_mps, layout)
    links: Array = np.array(rows[: layout.doppler], float).reshape(-1, 4)
    return np.asarray(np.degrees(links[:, 1:]))


def draw(path: Path) -> None:
    """Draw the conventions as a picture, seen from above and from the side."""
    with picture(path, 9.0, 8.6) as figure:
        above, side = figure.subplots(2, 1, height_ratios=(38, 15))
        _draw_above(above, angles_deg())
        _draw_side(side, float(angles_deg()[0, 1]))
        for axes in (above, side):
            axes.set_aspect("equal")
            axes.grid(visible=False)


def _draw_above(axes: Any, angles: Array) -> None:
    axes.set_title("From above: azimuths are counterclockwise from the x axis of the map")
    axes.set(xlabel="x (m, east)", ylabel="y (m, north)", xlim=_WIDTH_M, ylim=(-5.0, 33.0))
    wall = SCENE.walls[0]
    axes.axhline(wall.offset_m, color=_MUTED, linewidth=3.0)
    axes.text(-5.5, wall.offset_m + 0.7, "wall", color=_MUTED)
    user = np.array(USER_M[:2])
    names = ("anchor 1: base station", "anchor 2: its mirror image in the wall")
    for anchor, (arrival, _, departure), name in zip(SCENE.anchors_m, angles, names, strict=True):
        start = anchor[:2]
        line = "-" if name.startswith("anchor 1") else "--"
        axes.plot(*np.transpose([start, user]), color=_ANCHOR, linewidth=1.5, linestyle=line)
        axes.plot(*start, "^", color=_ANCHOR, markersize=12)
        axes.text(*(start + [0.0, 1.6 if start[1] else -3.0]), name, color=_ANCHOR, ha="left")
        _arc(axes, start, 7.0, arrival, f"aoa_azimuth {arrival:.1f}°", _ANCHOR)
        radius = 6.0 if start[1] == 0.0 else 9.0
        _arc(axes, user, radius, departure, f"aod_azimuth {departure:.1f}°", _USER)
    bounce = SCENE.anchors_m[1, :2] + (user - SCENE.anchors_m[1, :2]) * (
        (SCENE.anchors_m[1, 1] - wall.offset_m) / (SCENE.anchors_m[1, 1] - user[1])
    )
    axes.plot(*np.transpose([SCENE.anchors_m[0, :2], bounce]), color=_MUTED, linewidth=1.0)
    axes.text(*(bounce + [-3.0, 0.7]), "where the path is reflected", color=_MUTED, ha="right")
    axes.plot(*user, "o", color=_USER, markersize=10)
    axes.text(*(user + [1.0, -2.6]), "user", color=_USER)


def _draw_side(axes: Any, elevation: float) -> None:
    anchor = SCENE.anchors_m[0]
    away = float(np.hypot(*(np.array(USER_M) - anchor)[:2]))
    axes.set_title("From the side: elevation is from the horizon, at the anchor")
    axes.set(xlabel="horizontal distance (m)", ylabel="z (m)", xlim=_WIDTH_M, ylim=(0.0, 15.0))
    axes.plot([0.0, away], [anchor[2], USER_M[2]], color=_ANCHOR, linewidth=1.5)
    axes.plot(0.0, anchor[2], "^", color=_ANCHOR, markersize=12)
    axes.text(0.0, anchor[2] + 1.6, "anchor 1: base station", color=_ANCHOR)
    axes.plot(away, USER_M[2], "o", color=_USER, markersize=10)
    axes.text(away + 1.0, USER_M[2] + 0.6, "user", color=_USER)
    label = f"aoa_elevation {elevation:.1f}°:\nnegative, as the user is below"
    _arc(axes, np.array([0.0, anchor[2]]), 16.0, elevation, label, _ANCHOR)


def _arc(axes: Any, center: Array, radius: float, degrees: float, label: str, color: str) -> None:
    """Draw an arrow that turns by ``degrees`` from the horizontal, with its label beside it."""
    turn = np.radians(np.linspace(0.0, degrees, 60))
    line = center[:, None] + radius * np.array([np.cos(turn), np.sin(turn)])
    x = [center[0], center[0] + radius + 2.0]
    axes.plot(x, [center[1]] * 2, color=color, linewidth=0.8, linestyle=":")
    axes.plot(*line[:, :-1], color=color, linewidth=1.5)
    axes.annotate("", line[:, -1], line[:, -3], arrowprops={"arrowstyle": "-|>", "color": color})
    at = np.clip(0.5 * turn[-1], -0.8, 0.8)  # angle of the label: half of the arc, or 0.8 rad
    axes.text(
        *(center + (radius + 0.6) * np.array([np.cos(at), np.sin(at)])),
        label,
        color=color,
        va="center",
    )


if __name__ == "__main__":
    draw(Path(__file__).resolve().parents[1] / "angles.png")
