"""Texts of tracks for maps of the world: GeoJSON, GPX and NMEA 0183.

Positions in the scene are converted to latitude, longitude and height (WGS 84) by pymap3d, with the
origin that the scene states.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import reduce
from itertools import pairwise
from operator import xor
from typing import NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import pymap3d

from mmwave_env.localization.localizer import Track
from mmwave_env.models.scene import Origin, Scene
from mmwave_env.numerics.ellipses import axes_of, ellipse
from mmwave_env.numerics.numbers import Array

ELLIPSE_SHARE = 0.95
_DEVIATIONS = np.sqrt(-2.0 * np.log(1.0 - ELLIPSE_SHARE))  # chi quantile, 2 degrees of freedom
_CORNERS = 32  # number of corners of the polygon that approximates an ellipse
_ELLIPSES_APART_S = 1.0  # minimum time between ellipses; one per epoch would make files too large
_GEOJSON = '{"type": "FeatureCollection", "features": [\n'  # other programs write no line end here
_GPX = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<gpx version="1.1" creator="mmwave-loc" xmlns="http://www.topografix.com/GPX/1/1">'
)
UNIX_S = 1e8  # larger times are Unix times (1973 or later) and are written to GPX files


def east_north(origin: Origin) -> Array:
    """Return the matrix (2, 2) that turns x and y into east and north."""
    bearing = np.radians(origin.bearing_deg)
    return np.array([[np.sin(bearing), -np.cos(bearing)], [np.cos(bearing), np.sin(bearing)]])


def ellipses_of(origin: Origin, P: Array) -> list[Array]:
    """Return the half axes of error ellipses, major and minor, and azimuths of the major axes.

    The covariances P are packed, with x and y first; azimuths are in degrees clockwise from north
    (0 to 180).
    """
    major, minor, turn = axes_of(P)
    return [major, minor, (origin.bearing_deg - np.degrees(turn)) % 180.0]


def geodetic(origin: Origin, points_m: Array) -> Array:
    """Return latitude, longitude (degrees) and height (m) of points (n, 3) of the scene."""
    east, north = east_north(origin) @ points_m[:, :2].T
    up = points_m[:, 2]
    place = origin.latitude_deg, origin.longitude_deg, origin.height_m
    return np.column_stack(pymap3d.enu2geodetic(east, north, up, *place))


def _ellipses(origin: Origin, x: Array, P: Array) -> Array:
    """Return 95 % ellipses as closed rings (n, corners + 1, 2) of longitudes and latitudes."""
    corners = np.repeat(x[:, None, :3], _CORNERS, axis=1)
    corners[..., :2] = ellipse(x[:, :2], P, _DEVIATIONS, _CORNERS)
    around = geodetic(origin, corners.reshape(-1, 3)).reshape(len(x), _CORNERS, 3)
    return np.concatenate([around, around[:, :1]], axis=1)[..., [1, 0]]


def geojson(track: Track, origin: Origin, name: str) -> str:
    """Return a FeatureCollection: a line per segment, and a 95 % ellipse about every second."""
    features = [line for part in track.by_segment() for line in _features(part, origin, name)]
    return _GEOJSON + ",\n".join(map(json.dumps, features)) + "\n]}\n"


def _features(track: Track, origin: Origin, name: str) -> Iterator[dict[str, object]]:
    """Yield the features of a segment."""
    time_s = track.time_s.tolist()
    if len(time_s) > 1:
        points = geodetic(origin, track.smooth_x[:, :3]).round(9)[:, [1, 0, 2]].tolist()
        span = {"segment": int(track.segment[0]), "from_s": time_s[0], "to_s": time_s[-1]}
        yield _feature("LineString", _cut(points), name=name, **span)
    shown = []
    last_s = -np.inf
    for number, moment in enumerate(time_s):
        if moment - last_s >= _ELLIPSES_APART_S:
            shown.append(number)
            last_s = moment
    rings = _ellipses(origin, track.smooth_x[shown], track.smooth_P[shown]).round(9).tolist()
    for number, ring in zip(shown, rings, strict=True):
        parts = _cut(ring)
        if len(parts) > 1:  # the ring begins and ends on the same side
            parts[0] = parts.pop() + parts[0][1:]
            parts = [[*part, part[0]] for part in parts]
        yield _feature(
            "Polygon", [[part] for part in parts], time_s=time_s[number], share=ELLIPSE_SHARE
        )


def _cut(points: list[list[float]]) -> list[list[list[float]]]:
    """Cut a line of longitudes, latitudes, ... at the 180th meridian (RFC 7946, 3.1.9)."""
    parts = [points[:1]]
    for before, after in pairwise(points):
        if abs(after[0] - before[0]) > 180.0:
            side = math.copysign(180.0, before[0])
            east = after[0] + 2.0 * side - before[0]
            share = (side - before[0]) / east if east else 1.0
            middle = [a + share * (b - a) for a, b in zip(before[1:], after[1:], strict=True)]
            parts[-1].append([side, *middle])
            parts.append([[-side, *middle]])
        parts[-1].append(after)
    return parts


def _feature(kind: str, parts: Sequence[object], **properties: object) -> dict[str, object]:
    geometry = {"type": kind, "coordinates": parts[0]}
    if len(parts) > 1:
        geometry = {"type": f"Multi{kind}", "coordinates": parts}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def gpx(track: Track, origin: Origin, name: str) -> str:
    """Return a GPX 1.1 track; each segment of the log becomes an element ``trkseg``."""
    ascii_name = escape(name).encode("ascii", "xmlcharrefreplace").decode("ascii")
    lines = [f"{_GPX}<trk><name>{ascii_name}</name>"]
    for part in track.by_segment():
        lines.append("<trkseg>\n")
        points = geodetic(origin, part.smooth_x[:, :3]).tolist()
        for moment, (latitude, longitude, height) in zip(part.time_s.tolist(), points, strict=True):
            time = f"<time>{iso_time(moment)}</time>" if moment > UNIX_S else ""
            place = f'<trkpt lat="{latitude:.9f}" lon="{longitude:.9f}">'
            lines.append(f"{place}<ele>{height:.3f}</ele>{time}</trkpt>\n")
        lines.append("</trkseg>")
    return "".join(lines) + "</trk></gpx>\n"


def iso_time(moment: float) -> str:
    """Return a Unix time as a date and time (ISO 8601, UTC)."""
    try:
        date = datetime.fromtimestamp(moment, UTC)
    except (OSError, OverflowError, ValueError) as error:
        raise ValueError(
            f"out: GPX files can't have the time {moment!r} s, expected seconds since 1970, before "
            "the year 10000: is the column of times named after its unit?"
        ) from error
    return date.isoformat(timespec="milliseconds")[:-6] + "Z"


def nmea(track: Track, origin: Origin, name: str) -> str:
    """Return NMEA 0183: the sentences GGA (position) and GST (error statistics) of every epoch."""
    P = track.smooth_P
    turn = east_north(origin)
    variance = turn @ P[:, [0, 1, 1, 2]].reshape(-1, 2, 2) @ turn.T
    axes = np.sqrt(np.maximum([variance[:, 1, 1], variance[:, 0, 0], P[:, 5]], 0.0))
    numbers = np.vstack([*ellipses_of(origin, P), axes]).T.tolist()
    places = geodetic(origin, track.smooth_x[:, :3]).tolist()
    lines = []
    for moment, (latitude, longitude, height), errors in zip(
        track.time_s.tolist(), places, numbers, strict=True
    ):
        clock = _time_of_day(moment)
        where = f"{_degrees(latitude, 2, 'NS')},{_degrees(longitude, 3, 'EW')}"
        lines.append(_sentence(f"GPGGA,{clock},{where},1,,,{height:.3f},M,,M,,"))
        spread = "{:.3f},{:.3f},{:.1f},{:.3f},{:.3f},{:.3f}".format(*errors)
        lines.append(_sentence(f"GPGST,{clock},,{spread}"))
    return "".join(lines)


def _time_of_day(moment: float) -> str:
    milliseconds = round(moment % 86400.0 * 1000.0) % 86_400_000
    minutes = milliseconds // 60_000
    return f"{minutes // 60:02d}{minutes % 60:02d}{milliseconds / 1000.0 % 60.0:06.3f}"


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
    text: Callable[[Track, Origin, str], str]  # content of a file, given the track's name


MAP_FILES = {  # formats by the ending of the file's name
    ".geojson": MapFile(_GEOJSON, geojson),
    ".gpx": MapFile(_GPX, gpx),
    ".nmea": MapFile("$GPGGA,", nmea),
}


def origin_of(scene: Scene, option: str) -> Origin:
    """Return the origin of a scene; refuse the option that needs it if it is missing or far."""
    # far from its origin, the scene's axes are no longer east, north and up
    if scene.origin is None or abs(scene.anchors_m).max() > 1e5:
        raise ValueError(
            f"{option} needs the origin of scene {scene.name!r} at most 100 km from its anchors: "
            '"origin": {"latitude_deg": ..., "longitude_deg": ...} in its file (docs/data.md)'
        )
    return scene.origin
