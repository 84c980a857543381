"""Scenes: a base station, the walls that mirror it, and the streets on which users move.

A flat wall adds a *virtual anchor*, the mirror image of the physical anchor: a path with one
reflection has range and angles as if it came from the mirror image (paper, Sec. II).
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from mmwave_env.io.files import Json, shipped_json
from mmwave_env.io.lookup import as_name, choose
from mmwave_env.io.records import (
    Bound,
    Name,
    Record,
    Size,
    between,
    counts,
    object_from,
    read_object,
    require_fields,
)
from mmwave_env.models.envelope import POSITION_M
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from mmwave_env.numerics.numbers import Array, Matrix, Numbers

MOST_ANCHORS = 32  # with this many anchors, compiling takes a minute and a half

IMAGES = Size(0, MOST_ANCHORS - 1)  # limits of the number of mirror images
Coordinate = Annotated[float, POSITION_M]
_EACH = f"each {POSITION_M.expected}"
Point = Annotated[tuple[Coordinate, Coordinate, Coordinate], f"[x, y, z], {_EACH}"]
Place = Annotated[tuple[Coordinate, Coordinate], f"[x, y], {_EACH}"]
Extent = Annotated[tuple[Coordinate, Coordinate], f"[low, high], {_EACH}"]
Bearing = Annotated[float, between(-360.0, 360.0, "degrees")]
Offset = Annotated[float, between(-1e5, 1e5, "m")]
SIGMA_M = between(0.0, 1e4, "m")
Deviation = Annotated[float, SIGMA_M]
Offsets = Annotated[tuple[Offset, ...], Size(0, MOST_ANCHORS)]
OffsetSigmas = Annotated[tuple[Deviation, ...], Size(0, MOST_ANCHORS)]
Carrier = Annotated[float, Bound("hertz, 1e6 to 2.9e12", least=1e6, most=2.9e12)]
Bandwidth = Annotated[float, Bound("hertz, 1e5 to 1e12", least=1e5, most=1e12)]


@dataclass(frozen=True)
class Wall:
    """A vertical plane ``n . (x, y) = offset_m``; n is the normal, scaled to length 1.

    Attributes:
        normal: horizontal direction (2,), of any length except zero.
        offset_m: distance of the plane from the origin along the unit normal, m.
    """

    normal: Annotated[tuple[float, float], "[x, y]"]
    offset_m: Coordinate

    def __post_init__(self) -> None:
        require_fields(self)
        if not 0.0 < np.hypot(*self.normal) < np.inf:
            raise ValueError(f"normal: found {self.normal}, expected a nonzero vector")

    @property
    def unit_normal(self) -> tuple[float, float]:
        """Return the normal, scaled to length 1."""
        length = float(np.hypot(*self.normal))
        return self.normal[0] / length, self.normal[1] / length

    def signed_distance(self, point: Any) -> Any:
        """Return the signed distance of a point, or of points (3, n), from the wall, m."""
        nx, ny = self.unit_normal
        return nx * point[0] + ny * point[1] - self.offset_m

    def mirror(self, point: Point) -> Point:
        """Return the mirror image of a point."""
        nx, ny = self.unit_normal
        step = -2.0 * self.signed_distance(point)
        return point[0] + step * nx, point[1] + step * ny, point[2]


@dataclass(frozen=True)
class Origin(Record):
    """The location of a scene's origin on the earth (WGS 84).

    Attributes:
        latitude_deg, longitude_deg: latitude and longitude of the scene's point (0, 0, 0).
        height_m: height of this point above the ellipsoid.
        bearing_deg: direction of the x axis, clockwise from north; 90 is east.
    """

    latitude_deg: Annotated[float, between(-90.0, 90.0, "degrees")]
    longitude_deg: Annotated[float, between(-180.0, 180.0, "degrees")]
    height_m: Annotated[float, between(-1e4, 1e5, "m")] = 0.0
    bearing_deg: Bearing = 90.0


@dataclass(frozen=True)
class Streets(Record):
    """A rectangular grid of streets on which users move.

    Attributes:
        x_m: west-east extent (low, high), m.
        y_m: south-north extent (low, high), m.
        block_m: distance between parallel streets, m; both extents are multiples of it.
        height_m: height of the user equipment, m.
    """

    ordered = ("x_m", "y_m")

    x_m: Extent = (0.0, 160.0)
    y_m: Extent = (-160.0, 0.0)
    block_m: Annotated[float, between(1.0, 1e6, "m")] = 80.0
    height_m: Coordinate = 1.5

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.ordered:
            extent = getattr(self, name)
            blocks = (extent[1] - extent[0]) / self.block_m
            if abs(blocks - round(blocks)) > 1e-6:
                raise ValueError(
                    f"{name}: found {extent}, expected a whole number of blocks of {self.block_m} m"
                )
        if self.x_m[0] == self.x_m[1] and self.y_m[0] == self.y_m[1]:
            raise ValueError(f"x_m, y_m: found {self.x_m}, {self.y_m}, expected a length > 0")


@dataclass(frozen=True)
class LearnedImage(Record):
    """The knowledge about a mirror image that was learned from paths.

    Attributes:
        sigma_m: standard deviations of its position [x, y, z].
        paths: number of paths from which it was learned.
    """

    sigma_m: Annotated[
        tuple[Deviation, Deviation, Deviation], f"[x, y, z], each {SIGMA_M.expected}"
    ]
    paths: Annotated[int, counts(1, 1_000_000_000)]


Learned = Annotated[tuple[LearnedImage, ...], IMAGES]


class SceneNumbers(NamedTuple):
    """The numbers of a scene that a simulation needs; they may be SIMD lanes."""

    anchors: Matrix  # (L, 3) positions, m
    block_m: Any  # distance between parallel streets
    # extent_m: (2,) size of the streets, west-east and south-north; origin_m: south-west corner
    extent_m: Numbers
    origin_m: Numbers
    height_m: Any  # height of the user equipment


@dataclass(frozen=True)
class Scene:
    """A base station among walls.

    Attributes:
        name: name to show in results.
        base_station_m: position of the physical gNB.
        walls: walls that reflect the signal; each adds one virtual anchor.
        streets: streets on which simulated users move.
        carrier_hz: carrier frequency f_c.
        bandwidth_hz: signal bandwidth B.
        virtual_anchors_m: positions of more virtual anchors, from a survey or from ray tracing.
        origin: location on the earth; None if it is not known.
        side: a place [x, y] on the side of the users, if anchors on a line measure ranges alone,
            which fit a mirrored position as well; None if it is not known.
        bearing_deg: angle, clockwise from the x axis, of the direction from which a log's azimuths
            count. A log is read with its azimuths reduced by this angle.
        range_offset_m: for each anchor, the length by which the ranges of a log are too long, for
            example because of cables. A log is read with its ranges reduced by these. () for zeros.
        range_offset_sigma_m: standard deviations of these offsets, which add to the noise of the
            ranges; () for zeros.
        learned: knowledge about the last of ``virtual_anchors_m``, if they were learned.
    """

    name: Name
    base_station_m: Point
    walls: Annotated[tuple[Wall, ...], IMAGES] = ()
    streets: Streets = field(default_factory=Streets)
    carrier_hz: Carrier = 28e9
    bandwidth_hz: Bandwidth = 100e6
    virtual_anchors_m: Annotated[tuple[Point, ...], IMAGES] = ()
    origin: Origin | None = None
    side: Place | None = None
    bearing_deg: Bearing = 0.0
    range_offset_m: Offsets = ()
    range_offset_sigma_m: OffsetSigmas = ()
    learned: Learned = ()

    def __post_init__(self) -> None:
        require_fields(self)
        if len(self.learned) > len(self.virtual_anchors_m):
            raise ValueError(
                f"learned: found {len(self.learned)} images, expected at most "
                f"{len(self.virtual_anchors_m)}, the number of virtual anchors"
            )
        anchors = 1 + len(self.walls) + len(self.virtual_anchors_m)
        if anchors > MOST_ANCHORS:
            raise ValueError(
                f"walls, virtual_anchors_m: found {anchors} anchors, expected at most "
                f"{MOST_ANCHORS}"
            )
        for name in ("range_offset_m", "range_offset_sigma_m"):
            numbers = getattr(self, name)
            if len(numbers) not in (0, anchors):
                raise ValueError(
                    f"{name}: found {len(numbers)} numbers, expected one for each of the "
                    f"{anchors} anchors, with images in walls"
                )

    @property
    def anchors_m(self) -> Array:
        """Return the anchors (L, 3): the gNB, its image in each wall, and ``virtual_anchors_m``."""
        images = [wall.mirror(self.base_station_m) for wall in self.walls]
        return np.array([self.base_station_m, *images, *self.virtual_anchors_m], float)

    def with_anchors(self, anchors_m: Array) -> "Scene":
        """Return the scene with anchors (L, 3), the physical gNB first, and without walls."""
        gnb, *virtual = map(tuple, anchors_m.tolist())
        places = tuple(virtual)
        return replace(self, base_station_m=gnb, walls=(), virtual_anchors_m=places, learned=())

    @property
    def offsets_m(self) -> Array:
        """Return the offsets (L,) of the anchors' ranges."""
        return np.array(self.range_offset_m or [0.0] * len(self.anchors_m))

    @property
    def offset_sigmas_m(self) -> Array:
        """Return the standard deviations (L,) of these offsets."""
        return np.array(self.range_offset_sigma_m or [0.0] * len(self.anchors_m))

    @property
    def streets_known(self) -> bool:
        """Return whether the scene has walls, or streets other than the default."""
        return bool(self.walls) or self.streets != Streets()

    def require_streets_in_front(self) -> None:
        """Raise ValueError if streets are behind a wall, where the wall reflects no signals."""
        corners = [(x, y, 0.0) for x in self.streets.x_m for y in self.streets.y_m]
        default = " (the default; give the real ones)" if self.streets == Streets() else ""
        if self.first_behind(np.array(corners)) is not None:
            raise ValueError(
                f"streets of scene {self.name!r}: found {self.streets.x_m} x {self.streets.y_m}"
                f"{default}, expected all on the base station's side of every wall"
            )

    def first_behind(self, points_m: Array) -> int | None:
        """Return the index of the first of n points (n, 3) behind a wall; None if there is none."""
        for wall in self.walls:
            side = wall.signed_distance(self.base_station_m)
            behind = wall.signed_distance(points_m.T) * side <= 0.0
            if behind.any():
                return int(behind.argmax())
        return None

    @property
    def numbers(self) -> SceneNumbers:
        """Return the numbers that a simulation needs."""
        streets = self.streets
        west, east = streets.x_m
        south, north = streets.y_m
        extent = [east - west, north - south]
        anchors = self.anchors_m.tolist()
        return SceneNumbers(anchors, streets.block_m, extent, [west, south], streets.height_m)

    @property
    def hz_per_mps(self) -> float:
        """Return the Doppler shift at 1 m/s, f_c / c."""
        return self.carrier_hz / SPEED_OF_LIGHT


# Scenes for which the shipped filter banks were tuned and the shipped policies trained.
TRAINED_SCENES = ("street", "o1", "dynamic-doppler")


def scene_of_anchors(name: str, anchors_m: Array, carrier_hz: float, bandwidth_hz: float) -> Scene:
    """Return a scene of anchors (L, 3), the physical gNB first, with default streets, no walls."""
    scene = Scene(name, (0.0, 0.0, 0.0), carrier_hz=carrier_hz, bandwidth_hz=bandwidth_hz)
    return scene.with_anchors(anchors_m)


def scene_from(scene: "str | Path | Scene") -> Scene:
    """Return the scene of a ``scene=`` argument: a name, a JSON file or a Scene.

    Raises:
        ValueError: the name is unknown, or a field of the file is missing or wrong.
    """
    if isinstance(scene, Scene):
        return scene
    if str(scene).endswith(".json"):
        return read_scene(Path(scene))
    return choose(SCENES, str(scene), "scene", ", or a .json file")


def read_scene(path: Path) -> Scene:
    """Read a scene from a JSON file in one of two forms.

    A scene with walls contains base_station_m [x, y, z]; and, if they differ from the defaults,
    name, walls (a list of {"normal": [x, y], "offset_m": d}), streets, carrier_hz, bandwidth_hz,
    virtual_anchors_m (a list of [x, y, z]), origin, side, bearing_deg, range_offset_m and
    range_offset_sigma_m.

    A scene of anchors contains anchors (a list of [x, y, z], the physical gNB first), carrier_hz
    and bandwidth_hz; and, if they differ from the defaults, the other keys but walls.

    Raises:
        ValueError: the file is wrong; the message names the file and the error.
        FileNotFoundError: the file does not exist.
    """
    return read_object(
        path, "scene", lambda content: _scene({"name": as_name(path.stem)} | content)
    )


def scene_json(scene: Scene) -> Json:
    """Return the content of a scene file: with walls if the scene has any, else with anchors."""
    optional = {"bearing_deg", "range_offset_m", "range_offset_sigma_m", "learned"}
    content = {
        key: value
        for key, value in asdict(scene).items()
        if (value if key in optional else value is not None)
    }
    if not scene.walls:
        for key in ("base_station_m", "walls", "virtual_anchors_m"):
            del content[key]
        if not scene.streets_known:
            del content["streets"]
        return {"name": scene.name, "anchors": scene.anchors_m.tolist()} | content
    return content


@dataclass(frozen=True)
class AnchorScene(Record):
    """The content of a scene file that lists anchors instead of walls.

    Attributes:
        name: name to show in results.
        anchors: positions of the anchors, the physical gNB first.
        carrier_hz: carrier frequency f_c.
        bandwidth_hz: signal bandwidth B.
        streets: streets on which simulated users move.
        origin, side, bearing_deg, range_offset_m, range_offset_sigma_m, learned: as in a
            :class:`Scene`.
    """

    name: Name
    anchors: Annotated[tuple[Point, ...], Size(1, MOST_ANCHORS)]
    carrier_hz: Carrier
    bandwidth_hz: Bandwidth
    streets: Streets = field(default_factory=Streets)
    origin: Origin | None = None
    side: Place | None = None
    bearing_deg: Bearing = 0.0
    range_offset_m: Offsets = ()
    range_offset_sigma_m: OffsetSigmas = ()
    learned: Learned = ()


def _scene(content: Json) -> Scene:
    """Make a scene from the content of a file in one of the two forms."""
    if content.keys() & {"base_station_m", "walls"}:
        return object_from(Scene, content)
    values = dict(vars(object_from(AnchorScene, content)))
    gnb, *virtual = values.pop("anchors")
    return Scene(base_station_m=gnb, virtual_anchors_m=tuple(virtual), **values)


# the scenes of the package, by name; their file says where they come from
SCENES = {
    name: _scene({"name": name} | content["scene"])
    for name, content in shipped_json("scenes").items()
}
