"""Streets: the base station, the walls that mirror it, and where users move.

A flat wall turns the physical anchor into a *virtual anchor*, its mirror image: a path with
one reflection measures range and angles as if it came from there (paper, Sec. II).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmwave_env.lookup import choose
from mmwave_env.models.measurement import SPEED_OF_LIGHT

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Wall:
    """A vertical plane ``normal . (x, y) = offset_m``.

    Attributes:
        normal: horizontal direction (2,), any length but zero.
        offset_m: distance of the plane from the origin along the unit normal, m.
    """

    normal: tuple[float, float]
    offset_m: float

    def __post_init__(self) -> None:
        if not 0.0 < np.hypot(*self.normal) < np.inf:
            raise ValueError(f"normal: found {self.normal}, expected a direction")
        if not np.isfinite(self.offset_m):
            raise ValueError(f"offset_m: found {self.offset_m}, expected a number")

    @property
    def unit_normal(self) -> tuple[float, float]:
        """The normal with length 1."""
        length = float(np.hypot(*self.normal))
        return self.normal[0] / length, self.normal[1] / length

    def signed_distance(self, point: Point) -> float:
        """Signed distance of a point from the wall, m."""
        nx, ny = self.unit_normal
        return nx * point[0] + ny * point[1] - self.offset_m

    def mirror(self, point: Point) -> Point:
        """The mirror image of a point."""
        nx, ny = self.unit_normal
        step = -2.0 * self.signed_distance(point)
        return (point[0] + step * nx, point[1] + step * ny, point[2])


@dataclass(frozen=True)
class Streets:
    """A rectangular net of streets to move on.

    Attributes:
        x_m: west-east extent (low, high), m.
        y_m: south-north extent (low, high), m.
        block_m: distance of parallel streets, m; extents hold a whole number of blocks.
        height_m: height of the user equipment, m.
    """

    x_m: tuple[float, float] = (0.0, 160.0)
    y_m: tuple[float, float] = (-160.0, 0.0)
    block_m: float = 80.0
    height_m: float = 1.5

    def __post_init__(self) -> None:
        for name, extent in (("x_m", self.x_m), ("y_m", self.y_m)):
            if len(extent) != 2 or not -np.inf < extent[0] <= extent[1] < np.inf:
                raise ValueError(f"{name}: found {extent}, expected (low, high)")
        if not self.block_m > 0.0:
            raise ValueError(f"block_m: found {self.block_m}, expected > 0")
        for name, extent in (("x_m", self.x_m), ("y_m", self.y_m)):
            blocks = (extent[1] - extent[0]) / self.block_m
            if abs(blocks - round(blocks)) > 1e-6:
                raise ValueError(
                    f"{name}: found {extent}, expected a whole number of blocks of {self.block_m} m"
                )
        if self.x_m[0] == self.x_m[1] and self.y_m[0] == self.y_m[1]:
            raise ValueError(f"x_m, y_m: found {self.x_m}, {self.y_m}, expected a street")
        if not np.isfinite(self.height_m):
            raise ValueError(f"height_m: found {self.height_m}, expected a number")


@dataclass(frozen=True)
class Scene:
    """A base station among walls.

    Attributes:
        name: shown in results.
        base_station_m: position of the physical gNB.
        walls: each adds one virtual anchor.
        streets: where simulated users move.
        carrier_hz: carrier frequency f_c.
        bandwidth_hz: signal bandwidth B.
        virtual_anchors_m: more virtual anchors, given by position: surveyed, or found in a ray
            tracing.
    """

    name: str
    base_station_m: Point
    walls: tuple[Wall, ...] = ()
    streets: Streets = field(default_factory=Streets)
    carrier_hz: float = 28e9
    bandwidth_hz: float = 100e6
    virtual_anchors_m: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        if len(self.base_station_m) != 3 or not np.isfinite(self.base_station_m).all():
            raise ValueError(f"base_station_m: found {self.base_station_m}, expected x, y, z")
        for i, anchor in enumerate(self.virtual_anchors_m):
            if len(anchor) != 3 or not np.isfinite(anchor).all():
                raise ValueError(f"virtual_anchors_m[{i}]: found {anchor}, expected x, y, z")
        for name, hz, least in (("carrier_hz", self.carrier_hz, "1e6"),
                                ("bandwidth_hz", self.bandwidth_hz, "1e3")):  # fmt: skip
            if not float(least) <= hz < np.inf:
                raise ValueError(f"{name}: found {hz:g}, expected hertz, at least {least}")

    @property
    def anchors_m(self) -> NDArray[np.float64]:
        """Anchors (L, 3): the gNB, its image in each wall, then the other virtual anchors."""
        images = [wall.mirror(self.base_station_m) for wall in self.walls]
        return np.array([self.base_station_m, *images, *self.virtual_anchors_m], float)

    def require_streets_in_front(self) -> None:
        """Refuse streets behind a wall, where its mirror image can't be seen.

        Raises:
            ValueError: naming the wall.
        """
        for wall in self.walls:
            gnb = wall.signed_distance(self.base_station_m)
            corners = [(x, y, 0.0) for x in self.streets.x_m for y in self.streets.y_m]
            if any(wall.signed_distance(corner) * gnb <= 0.0 for corner in corners):
                raise ValueError(
                    f"streets of scene {self.name!r}: found {self.streets.x_m} x "
                    f"{self.streets.y_m}, expected all on the base station's side of {wall}"
                )

    @property
    def hz_per_mps(self) -> float:
        """Doppler shift of 1 m/s, f_c / c."""
        return self.carrier_hz / SPEED_OF_LIGHT


SCENES: dict[str, Scene] = {
    # Design of this project: gNB over a crossing, a facade to the north and one to the east.
    "street": Scene("street", (10.0, 10.0, 10.0), (Wall((0, 1), 25.0), Wall((1, 0), 185.0))),
    # After DeepMIMO O1 (28 GHz): main street 600 x 40 m, facades 52 m apart, BS3, users at 2 m.
    # The building that closes the street to the north is this project's assumption.
    "o1": Scene(
        "o1",
        (235.504, 489.504, 6.0),
        (Wall((1, 0), 286.504), Wall((0, 1), 845.0)),
        Streets((260.5, 260.5), (240.0, 840.0), block_m=120.0, height_m=2.0),
    ),
    # After DeepMIMO Dynamic Doppler (28 GHz): main street 430 x 15 m, first base station; users
    # stay on the main street. The two walls are this project's assumption.
    "dynamic-doppler": Scene(
        "dynamic-doppler",
        (7.0, 14.0, 4.5),
        (Wall((0, 1), -25.0), Wall((1, 0), 225.0)),
        Streets((-215.0, 215.0), (0.0, 0.0), block_m=107.5),
    ),
}


def scene_from(scene: "str | Path | Scene") -> Scene:
    """The scene of a ``scene=`` argument: a name, a JSON file or a Scene.

    Raises:
        ValueError: unknown name, or a file that lacks a field or holds something else there.
    """
    if isinstance(scene, Scene):
        return scene
    if str(scene).endswith(".json"):
        return read_scene(Path(scene))
    return choose(SCENES, str(scene), "scene")


def read_scene(path: Path) -> Scene:
    """A scene from a JSON file, in one of two forms.

    By its walls: base_station_m [x, y, z]; and, where they differ from the defaults, name,
    walls (a list of {"normal": [x, y], "offset_m": d}), streets, carrier_hz, bandwidth_hz and
    virtual_anchors_m (a list of [x, y, z]).

    By its anchors: anchors (a list of [x, y, z], the physical gNB first), carrier_hz and
    bandwidth_hz; and, where they differ from the defaults, name and streets.

    Raises:
        ValueError: naming the file and what is wrong in it.
        FileNotFoundError: there is no such file.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError(f"found {type(content).__name__}, expected an object")
        given = _from_anchors(content) if "anchors" in content else _from_walls(content)
        return Scene(**{"name": path.stem, **given})
    except (TypeError, KeyError, AttributeError, ValueError, RecursionError) as error:
        what = error if type(error) is ValueError else repr(error)
        raise ValueError(f"{path}: not a scene: {what}") from error


def anchors_json(scene: Scene) -> dict[str, Any]:
    """The scene by its anchors, as :func:`read_scene` reads it; walls and streets are lost."""
    return {
        "name": scene.name,
        "anchors": scene.anchors_m.tolist(),
        "carrier_hz": scene.carrier_hz,
        "bandwidth_hz": scene.bandwidth_hz,
    }


def _from_anchors(content: dict[str, Any]) -> dict[str, Any]:
    """Fields of a Scene from a file that lists anchors."""
    mixed = [key for key in ("base_station_m", "walls", "virtual_anchors_m") if key in content]
    if mixed:
        raise ValueError(
            f"found anchors and {', '.join(mixed)}, expected either all anchors, the physical "
            "gNB first, or base_station_m and walls"
        )
    _require_keys(content, ("anchors", "carrier_hz", "bandwidth_hz"), ("name", "streets"))
    anchors = content["anchors"]
    if not isinstance(anchors, list) or not anchors:
        raise ValueError(f"anchors: found {anchors!r}, expected a list of [x, y, z]")
    points = [_point(f"anchors[{i}]", anchor) for i, anchor in enumerate(anchors)]
    rest = {key: value for key, value in _common(content).items() if key != "anchors"}
    return {**rest, "base_station_m": points[0], "virtual_anchors_m": tuple(points[1:])}


def _from_walls(content: dict[str, Any]) -> dict[str, Any]:
    """Fields of a Scene from a file that has its base station and walls."""
    if "base_station_m" not in content:
        raise ValueError(
            "found neither base_station_m nor anchors, expected base_station_m [x, y, z] and "
            "walls, or anchors [[x, y, z], ...]"
        )
    _require_keys(content, (), [f.name for f in fields(Scene)])
    virtual = content.get("virtual_anchors_m", [])
    return {
        **_common(content),
        "base_station_m": _point("base_station_m", content["base_station_m"]),
        "walls": tuple(
            Wall(tuple(wall["normal"]), float(wall["offset_m"]))
            for wall in content.get("walls", [])
        ),
        "virtual_anchors_m": tuple(
            _point(f"virtual_anchors_m[{i}]", anchor) for i, anchor in enumerate(virtual)
        ),
    }


def _common(content: dict[str, Any]) -> dict[str, Any]:
    """The content, with what both forms share made into what a Scene has."""
    out = dict(content)
    for key in ("carrier_hz", "bandwidth_hz"):
        if key in out:
            out[key] = float(out[key])
    if "streets" in out:
        streets: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value
            for key, value in out["streets"].items()
        }
        out["streets"] = Streets(**streets)
    return out


def _point(what: str, found: object) -> Point:
    try:
        x, y, z = np.asarray(found, float).tolist()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: found {found!r}, expected [x, y, z]") from error
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"{what}: found {found!r}, expected finite numbers")
    return x, y, z


def _require_keys(
    content: dict[str, Any], required: Sequence[str], optional: Sequence[str]
) -> None:
    """Refuse a file that lacks a key or has one that means nothing."""
    for key in content:
        if key not in required and key not in optional:
            known = ", ".join([*required, *optional])
            raise ValueError(f"found the key {key!r}, expected only {known}")
    for key in required:
        if key not in content:
            raise ValueError(f"found no {key}, expected one beside {', '.join(content)}")
