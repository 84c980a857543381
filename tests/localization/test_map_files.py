"""Tests of tracks written as GPX, NMEA and GeoJSON, which other libraries must read correctly."""

import json
from dataclasses import replace

import gpxpy
import numpy as np
import pymap3d
import pynmea2
import pytest
from numpy.testing import assert_allclose

from mmwave_env.localization.localizer import Track
from mmwave_env.localization.map_files import MAP_FILES
from mmwave_env.localization.track_files import require_own_files, write_track
from mmwave_env.models.scene import SCENES, Origin, scene_of_anchors
from tests.localization.test_track_files import some_track
from tests.refusals import refuses

ORIGIN = Origin(60.1867, 24.8277, 20.0, bearing_deg=37.0)
SCENE = replace(SCENES["street"], origin=ORIGIN)
NOON_S = 1_764_072_000.0  # 2025-11-25 12:00 UTC


def tracks():
    """Return two segments of a track with epochs 0.5 s apart."""
    parts = []
    for number, (epochs, start) in enumerate([(9, 0.0), (5, 60.0)]):
        time_s = NOON_S + start + 0.5 * np.arange(epochs)
        segment = np.full(epochs, number)
        parts.append(replace(some_track(epochs, number), time_s=time_s, segment=segment))
    return parts


def written(tmp_path, ending, parts):
    path = tmp_path / f"walk{ending}"
    write_track(Track.joined(parts), [path], SCENE, "walk")
    return path


def places(parts):
    """Compute latitude, longitude and height (n, 3) from azimuths and distances with pymap3d."""
    x, y, up = np.concatenate([part.smooth_x[:, :3] for part in parts]).T
    angle = np.arctan2(y, x)
    length = np.hypot(x, y)
    azimuth = np.degrees(np.radians(ORIGIN.bearing_deg) - angle)
    slant = np.hypot(length, up)
    elevation = np.degrees(np.arctan2(up, length))
    where = ORIGIN.latitude_deg, ORIGIN.longitude_deg, ORIGIN.height_m
    return np.column_stack(pymap3d.aer2geodetic(azimuth, elevation, slant, *where))


def test_gpx_has_every_segment_of_the_track_with_its_times(tmp_path):
    parts = tracks()
    content = gpxpy.parse(written(tmp_path, ".gpx", parts).read_text())
    (track,) = content.tracks
    assert [len(segment.points) for segment in track.segments] == [9, 5]
    points = [point for segment in track.segments for point in segment.points]
    shown = [(p.latitude, p.longitude, p.elevation) for p in points]
    assert_allclose(shown, places(parts), atol=1e-3, rtol=0.0)
    assert_allclose(np.array(shown)[:, :2], places(parts)[:, :2], atol=1e-8, rtol=0.0)
    moments = [point.time.timestamp() for point in points]
    assert_allclose(moments, np.concatenate([p.time_s for p in parts]), atol=1e-3)


def test_nmea_has_positions_and_standard_deviations(tmp_path):
    parts = tracks()
    lines = written(tmp_path, ".nmea", parts).read_bytes().decode().split("\r\n")[:-1]
    sentences = [pynmea2.parse(line, check=True) for line in lines]
    expected = places(parts)
    P = np.concatenate([part.smooth_P for part in parts])
    assert [s.sentence_type for s in sentences] == ["GGA", "GST"] * len(expected)
    for position, spread, place, packed in zip(
        sentences[::2], sentences[1::2], expected, P, strict=True
    ):
        shown = position.latitude, position.longitude, float(position.altitude)
        assert_allclose(shown, place, atol=1e-3, rtol=0.0)
        assert_allclose(shown[:2], place[:2], atol=1e-8, rtol=0.0)
        horizontal = np.array([[packed[0], packed[1]], [packed[1], packed[2]]])
        size = np.sqrt(np.linalg.eigvalsh(horizontal))
        axes = float(spread.std_dev_minor), float(spread.std_dev_major)
        assert_allclose(axes, size, atol=1e-3)
        total = float(spread.std_dev_latitude) ** 2 + float(spread.std_dev_longitude) ** 2
        assert total == pytest.approx(np.trace(horizontal), abs=1e-2)
        assert float(spread.std_dev_altitude) == pytest.approx(np.sqrt(packed[5]), abs=1e-3)
    assert sentences[0].timestamp.isoformat() == "12:00:00+00:00"


def area(ring):
    """Return the area in m^2 of a counterclockwise ring of points (longitude, latitude)."""
    longitude, latitude = np.array(ring).T
    where = ORIGIN.latitude_deg, longitude[0], ORIGIN.height_m
    east, north, _ = pymap3d.geodetic2enu(latitude, longitude, ORIGIN.height_m, *where)
    return 0.5 * (np.dot(east[:-1], north[1:]) - np.dot(east[1:], north[:-1]))


@pytest.mark.parametrize("longitude", [179.99995, 180.0, -179.9999, 180.0 - 1e-9])
def test_geojson_is_cut_at_the_180th_meridian(tmp_path, longitude):
    scene = replace(SCENE, origin=replace(ORIGIN, longitude_deg=longitude))
    path = tmp_path / "walk.geojson"
    write_track(Track.joined(tracks()), [path], scene)
    shapes = [feature["geometry"] for feature in json.loads(path.read_text())["features"]]
    whole = json.loads(written(tmp_path, ".geojson", tracks()).read_text())["features"]
    assert any(shape["type"].startswith("Multi") for shape in shapes)
    for shape, feature in zip(shapes, whole, strict=True):
        parts = (
            shape["coordinates"] if shape["type"].startswith("Multi") else [shape["coordinates"]]
        )
        if shape["type"].endswith("Polygon"):
            parts = [ring for (ring,) in parts]
            sizes = [area(ring) for ring in parts]
            assert min(sizes) >= 0.0
            assert sum(sizes) == pytest.approx(area(*feature["geometry"]["coordinates"]), rel=1e-3)
        assert all(np.ptp([point[0] for point in part]) < 0.1 for part in parts)


def test_times_have_milliseconds_and_must_be_before_the_year_10000(tmp_path):
    track = some_track(2)
    track = replace(track, time_s=NOON_S + np.array([0.0, 0.001]))
    write_track(track, [tmp_path / "t.nmea"], SCENE)
    assert "$GPGGA,120000.001," in (tmp_path / "t.nmea").read_text()
    with refuses("out"):
        write_track(replace(track, time_s=1e3 * track.time_s), [tmp_path / "t.gpx"], SCENE)


def test_geojson_has_lines_within_segments_and_95_percent_error_ellipses(tmp_path):
    parts = tracks()
    features = json.loads(written(tmp_path, ".geojson", parts).read_text())["features"]
    lines = [f for f in features if f["geometry"]["type"] == "LineString"]
    assert [len(f["geometry"]["coordinates"]) for f in lines] == [9, 5]
    first, second = (f["geometry"]["coordinates"] for f in lines)
    assert_allclose(np.array([*first, *second])[:, [1, 0]], places(parts)[:, :2], atol=1e-8)
    rings = {f["properties"]["time_s"]: f["geometry"] for f in features if f not in lines}
    by_time = {t: P for p in parts for t, P in zip(p.time_s, p.smooth_P, strict=True)}
    assert list(rings) == [t for p in parts for t in p.time_s[::2]]  # one ellipse per second
    polygon = 16.0 * np.sin(np.pi / 16.0)  # area of a polygon with 32 corners on a unit circle
    # 5.991 is the 95 % quantile of the chi-square distribution with two degrees of freedom.
    for time_s, geometry in rings.items():
        (ring,) = geometry["coordinates"]
        P = by_time[time_s]
        assert ring[0] == ring[-1]
        size = 5.991 * np.sqrt(P[0] * P[2] - P[1] ** 2) * polygon
        assert area(ring) == pytest.approx(size, rel=2e-3)


@pytest.mark.parametrize("ending", MAP_FILES)
def test_a_map_file_needs_an_origin_and_replaces_only_files_of_its_kind(tmp_path, ending):
    path = tmp_path / f"walk{ending}"
    anchors_m = np.array([[691e3, 5_334e3, 526.0], [691e3, 5_335e3, 526.0]])
    in_utm = replace(scene_of_anchors("utm", anchors_m, 28e9, 100e6), origin=ORIGIN)
    for scene in (SCENES["street"], in_utm):
        with refuses("out"):
            write_track(some_track(3), [path], scene)
    written(tmp_path, ending, tracks())
    require_own_files(path)
    for theirs in ("{}", json.dumps({"type": "FeatureCollection", "features": [{}]})):
        path.write_text(theirs)
        with refuses("out"):
            require_own_files(path)
