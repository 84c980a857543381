"""Track files for maps of the world: GeoJSON, GPX and NMEA 0183, written block by block.

Positions in the scene are converted to latitude, longitude and height (WGS 84) by pymap3d, with the
origin that the scene states.
"""

import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path
from typing import NamedTuple, TextIO
from xml.sax.saxutils import escape

import numpy as np
import pymap3d

from mmwave_env.io.files import atomic_path
from mmwave_env.localization.localizer import TrackBlock
from mmwave_env.models.scene import Origin, Scene
from mmwave_env.numerics.numbers import Array

ELLIPSE_SHARE = 0.95
_ELLIPSE_NIS = -2.0 * np.log(1.0 - ELLIPSE_SHARE)  # chi-square quantile, 2 degrees of freedom
Write = Callable[[TrackBlock], None]
_CORNERS = 32  # number of corners of the polygon that approximates an ellipse
_ELLIPSES_APART_S = 1.0  # minimum time between ellipses; one per epoch would make files too large
_GEOJSON = '{"type": "FeatureCollection", "features": ['
_GPX = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<gpx version="1.1" creator="mmwave-loc" xmlns="http://www.topografix.com/GPX/1/1">'
)
_UNIX_S = 1e8  # larger times are Unix times (1973 or later) and are written to GPX files


def geodetic(origin: Origin, points_m: Array) -> Array:
    """Return latitude, longitude (degrees) and height (m) of points (n, 3) of the scene."""
    bearing = np.radians(origin.bearing_deg)
    x, y, up = points_m.T
    east = x * np.sin(bearing) - y * np.cos(bearing)
    north = x * np.cos(bearing) + y * np.sin(bearing)
    place = origin.latitude_deg, origin.longitude_deg, origin.height_m
    return np.column_stack(pymap3d.enu2geodetic(east, north, up, *place))


def _ellipses(origin: Origin, x: Array, P: Array) -> Array:
    """Return 95 % ellipses as closed rings (n, corners + 1, 2) of longitudes and latitudes."""
    variance = np.array([[P[:, 0], P[:, 1]], [P[:, 1], P[:, 2]]]).transpose(2, 0, 1)
    size, axes = np.linalg.eigh(variance)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # rings are counterclockwise (RFC 7946)
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    radius = np.sqrt(_ELLIPSE_NIS * np.maximum(size, 0.0))
    offsets = (axes * radius[:, None]) @ circle  # (n, 2, corners)
    corners = np.repeat(x[:, None, :3], _CORNERS, axis=1)
    corners[..., :2] += offsets.transpose(0, 2, 1)
    around = geodetic(origin, corners.reshape(-1, 3)).reshape(len(x), _CORNERS, 3)
    return np.concatenate([around, around[:, :1]], axis=1)[..., [1, 0]]


@contextmanager
def _geojson(file: TextIO, origin: Origin, name: str) -> Iterator[Write]:
    """Write a FeatureCollection: lines of the track, and at most one 95 % ellipse per second."""
    separator = ""
    # segment of the last block, time of the last ellipse, last point
    last: tuple[int, float, list[float]] = -1, -np.inf, []
    file.write(_GEOJSON)

    def feature(kind: str, coordinates: object, **properties: object) -> None:
        nonlocal separator
        geometry = {"type": kind, "coordinates": coordinates}
        content = {"type": "Feature", "properties": properties, "geometry": geometry}
        file.write(f"{separator}\n{json.dumps(content)}")
        separator = ","

    def write(block: TrackBlock) -> None:
        nonlocal last
        time_s = block.time_s
        x = block.smooth_x
        P = block.smooth_P
        segment = block.segment
        before, ellipse_s, point = last
        points = geodetic(origin, x[:, :3]).round(9)[:, [1, 0, 2]].tolist()
        line = [*([point] if segment == before else []), *points]
        if len(line) > 1:
            span = {"from_s": float(time_s[0]), "to_s": float(time_s[-1])}
            feature("LineString", line, name=name, segment=segment, **span)
        shown = []
        for number, moment in enumerate(time_s.tolist()):
            if segment != before or moment - ellipse_s >= _ELLIPSES_APART_S:
                shown.append(number)
                before = segment
                ellipse_s = moment
        for number, ring in zip(shown, _ellipses(origin, x[shown], P[shown]), strict=True):
            corners = ring.round(9).tolist()
            feature("Polygon", [corners], time_s=float(time_s[number]), share=ELLIPSE_SHARE)
        last = segment, ellipse_s, points[-1]

    yield write
    file.write("\n]}\n")


@contextmanager
def _gpx(file: TextIO, origin: Origin, name: str) -> Iterator[Write]:
    """Write a GPX 1.1 track; each segment of the log becomes an element ``trkseg``."""
    ascii_name = escape(name).encode("ascii", "xmlcharrefreplace").decode("ascii")
    file.write(f"{_GPX}<trk><name>{ascii_name}</name>")
    current = -1

    def write(block: TrackBlock) -> None:
        nonlocal current
        if block.segment != current:
            file.write(f"{'</trkseg>' if current >= 0 else ''}<trkseg>\n")
            current = block.segment
        points = geodetic(origin, block.smooth_x[:, :3]).tolist()
        moments = block.time_s.tolist()
        for moment, (latitude, longitude, height) in zip(moments, points, strict=True):
            time = f"<time>{_iso(moment)}</time>" if moment > _UNIX_S else ""
            place = f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}">'
            file.write(f"{place}<ele>{height:.3f}</ele>{time}</trkpt>\n")

    yield write
    file.write(f"{'</trkseg>' if current >= 0 else ''}</trk></gpx>\n")


def _iso(moment: float) -> str:
    try:
        date = datetime.fromtimestamp(moment, UTC)
    except (OSError, OverflowError, ValueError) as error:
        raise ValueError(f"time: found {moment:g} s, expected seconds since 1970") from error
    return date.isoformat(timespec="milliseconds")[:-6] + "Z"


@contextmanager
def _nmea(file: TextIO, origin: Origin, name: str) -> Iterator[Write]:
    """Write NMEA 0183: the sentences GGA (position) and GST (error statistics) of every epoch."""

    def write(block: TrackBlock) -> None:
        places = geodetic(origin, block.smooth_x[:, :3])
        moments = block.time_s.tolist()
        for moment, place, packed in zip(moments, places, block.smooth_P, strict=True):
            file.write(nmea(origin, moment, place, packed))

    yield write


def nmea(origin: Origin, moment: float, place: Array, packed: Array) -> str:
    """Return the sentences GGA and GST of an epoch.

    Args:
        origin: place and bearing of the scene on the earth.
        moment: time, s; the sentences contain only its time of day.
        place: (3,) latitude and longitude (degrees) and height (m).
        packed: (28,) packed covariance of the state, or (36,) with a clock offset.
    """
    hundredths = round(moment % 86400.0 * 100.0) % 8_640_000
    seconds = hundredths / 100.0 % 60.0
    minutes = hundredths // 6000
    clock = f"{minutes // 60:02d}{minutes % 60:02d}{seconds:05.2f}"
    latitude, longitude, height = place
    where = f"{_degrees(latitude, 2, 'NS')},{_degrees(longitude, 3, 'EW')}"
    bearing = np.radians(origin.bearing_deg)
    turn = np.array([[np.sin(bearing), -np.cos(bearing)], [np.cos(bearing), np.sin(bearing)]])
    xx, xy, yy = packed[:3]
    east_north = turn @ np.array([[xx, xy], [xy, yy]]) @ turn.T
    size, axes = np.linalg.eigh(east_north)
    minor, major = np.sqrt(np.maximum(size, 0.0))
    along = np.degrees(np.arctan2(axes[0, 1], axes[1, 1])) % 180.0  # from true north, clockwise
    east, north = np.sqrt(np.maximum(np.diag(east_north), 0.0))
    up = np.sqrt(max(packed[5], 0.0))
    spread = f"{major:.3f},{minor:.3f},{along:.1f},{north:.3f},{east:.3f},{up:.3f}"
    return _sentence(f"GPGGA,{clock},{where},1,,,{height:.3f},M,,M,,") + _sentence(
        f"GPGST,{clock},,{spread}"
    )


def _degrees(angle: float, digits: int, sides: str) -> str:
    """Return degrees and minutes as NMEA writes them, with the hemisphere."""
    minutes = round(abs(angle) * 60.0 * 1e7)  # 1e-7 minutes are 0.2 mm
    whole, rest = divmod(minutes, 600_000_000)
    return f"{whole:0{digits}d}{rest / 1e7:010.7f},{sides[int(angle < 0.0)]}"


def _sentence(text: str) -> str:
    """Return an NMEA sentence: a text and its checksum, the exclusive or of its characters."""
    return f"${text}*{reduce(xor, text.encode()):02X}\r\n"


class MapFile(NamedTuple):
    """A format of files for maps."""

    header: str  # text with which every file of this format begins
    writer: Callable[[TextIO, Origin, str], AbstractContextManager[Write]]


MAP_FILES = {  # formats by the ending of the file's name
    ".geojson": MapFile(_GEOJSON, _geojson),
    ".gpx": MapFile(_GPX, _gpx),
    ".nmea": MapFile("$GPGGA,", _nmea),
}


@contextmanager
def map_file(path: Path, scene: Scene, name: str) -> Iterator[Write]:
    """Yield a function that writes the next block of a track; the file appears once it is complete.

    Args:
        path: file to write; its ending is a key of :data:`MAP_FILES`.
        scene: scene with an origin.
        name: name of the track.

    Raises:
        ValueError: the scene has no origin.
    """
    if scene.origin is None:
        raise ValueError(
            f"out: {path} needs the origin of scene {scene.name!r}, which has none; add "
            '"origin": {"latitude_deg": ..., "longitude_deg": ...} to its file (docs/data.md)'
        )
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="ascii", newline="") as file,
        MAP_FILES[path.suffix].writer(file, scene.origin, name) as write,
    ):
        yield write
