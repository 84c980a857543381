"""Tests of measurement logs: columns, units, variants of CSV, writing, conventions of angles."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.datasets.log_folder import log_columns, log_text
from mmwave_env.logs.live_log import LiveLog, log_from
from mmwave_env.logs.log import read_paths
from mmwave_env.logs.log_columns import QUANTITIES
from mmwave_env.models.layout import Layout, wrapped
from mmwave_env.models.measurement import SPEED_OF_LIGHT, exact_rows, seen_from_image
from mmwave_env.models.radio import RADIOS
from tests.logs.by_hand import (
    COLUMNS,
    HEADER,
    SCENE,
    SUFFIXES,
    L,
    assert_same,
    episode,
    in_body,
    read,
    read_back,
    read_live,
    require_pyarrow,
    rows,
    shown,
    store,
    text,
    write_log,
)
from tests.paths import ROOT


def test_every_number_is_read_into_its_array(tmp_path):
    block = read_back(tmp_path, rows())
    assert block.layout == Layout(L, partial=True) and len(block) == 4
    assert_array_equal(block.time_s, [0.0, 1.0, 2.0, 3.0])
    assert block.visible.all() and not block.incomplete.any()
    assert_allclose(block.measurement[2, 4], 4e-7 * SPEED_OF_LIGHT, rtol=1e-15)
    assert_allclose(block.measurement[2, 5:8], [0.22, -0.2, 0.2], rtol=1e-14)
    assert_array_equal(block.measurement[:, -1], [0.5, 1.5, 2.5, 3.5])
    assert_array_equal(block.snr_db, np.tile([21.0, 22.0, 23.0], (4, 1)))
    assert_array_equal(block.doppler_spread_hz, np.zeros(4))
    assert block.line.tolist() == [2, 5, 8, 11] and block.damage is None


@pytest.mark.parametrize("suffix", ["rad", "deg"])
def test_angles_of_arrival_at_the_base_station_are_mirrored(tmp_path, suffix):
    ours = episode(epochs=5)
    columns = log_columns(ours)
    path = tmp_path / "station.csv"
    rays = columns.pop("aoa_azimuth_rad"), columns["aoa_elevation_rad"], columns["anchor"]
    station, *_ = anchors_m = SCENE.anchors_m.tolist()
    # What a mirror makes of a mirrored direction is the direction itself.
    mirrored = [
        seen_from_image(azimuth, elevation, station, anchors_m[int(anchor) - 1])
        for azimuth, elevation, anchor in zip(*rays, strict=True)
    ]
    arrival, columns["aoa_elevation_rad"] = np.array(mirrored).T
    columns[f"aoa_azimuth_station_{suffix}"] = np.degrees(arrival) if suffix == "deg" else arrival
    path.write_text(log_text(columns))
    write_log(tmp_path / "image.csv", ours)
    block = read(path)
    image = read(tmp_path / "image.csv")
    assert_array_equal(block.visible, image.visible)
    assert_allclose(block.measurement, image.measurement, rtol=1e-9)
    ours = read_paths(path, SCENE)
    theirs = read_paths(tmp_path / "image.csv", SCENE)
    direct = columns["anchor"] == 1
    assert ours.at_station and not theirs.at_station
    assert_allclose(ours.links[direct], theirs.links[direct], rtol=1e-9)


@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("speed", [{}, {"speed_mps": "1.5"}])
def test_angles_of_departure_in_the_frame_of_the_body_are_turned_by_the_heading(
    tmp_path, speed, odometry
):
    lines = rows(2)
    for line, heading in zip(lines, ("", "170", "", "-40", "", "-40"), strict=True):
        line.update(speed, aod_azimuth_rad="20.0", heading_deg=heading)
    block = read_back(tmp_path, in_body(text(lines)), odometry=odometry)
    departures = np.degrees(block.measurement[:, 3:12:4])
    assert_allclose(departures, [[-170.0] * 3, [-20.0] * 3])
    assert block.visible.all()
    assert block.layout == Layout(L, odometry and bool(speed), partial=True)


def test_a_link_is_incomplete_if_its_departure_needs_a_missing_heading(tmp_path):
    lines = [line | {"heading_deg": "90" if line["time_s"] == "1" else ""} for line in rows(2)]
    block = read_back(tmp_path, in_body(text(lines))).whole()
    assert_array_equal(block.visible[:, :L], [[False] * 3, [True] * 3])
    assert_array_equal(block.incomplete[:, :L], [[True] * 3, [False] * 3])


# column for the time of flight -> its value for a flight of 1e-7 s
FLIGHTS = {"toa_s": 1e-7, "toa_ms": 1e-4, "toa_us": 0.1, "toa_ns": 100, "range_m": 29.9792458}
FLIGHTS |= {"range_ft": 29.9792458 / 0.3048, "rtt_ns": 200}
AZIMUTHS = ("aoa_azimuth", "aod_azimuth")
ANGLES = {"aoa_azimuth": 1, "aoa_elevation": 2, "aod_azimuth": 3}  # indices in the rows of a link


@pytest.mark.parametrize(
    ("name", "value", "row", "expected"),
    [
        ("time_s", 1.5, None, 1.5),
        ("time_ms", 1500, None, 1.5),
        ("time_us", 1.5e6, None, 1.5),
        ("time_ns", 1500000000, None, 1.5),
        *((name, flight, 0, 1e-7 * SPEED_OF_LIGHT) for name, flight in FLIGHTS.items()),
        *((f"{angle}_rad", -1.5, row, -1.5) for angle, row in ANGLES.items()),
        *((f"{angle}_deg", 45, row, np.pi / 4) for angle, row in ANGLES.items()),
        *((f"{angle}_deg", 270, ANGLES[angle], -np.pi / 2) for angle in AZIMUTHS),
        ("aoa_azimuth_deg", 180, 1, -np.pi),
        ("doppler_hz", -934.0, 12, -934.0),
        ("doppler_khz", -0.934, 12, -934.0),
        ("doppler_mps", 2.0, 12, 2.0 * 28e9 / SPEED_OF_LIGHT),
    ],
)
def test_units_are_converted(tmp_path, name, value, row, expected):
    (names,) = [row.columns for row in QUANTITIES.values() if name in row.columns]
    cells = dict.fromkeys(COLUMNS, "0.5") | {"time_s": "1", "anchor": "1", "toa_s": "1e-7"}
    cells = {column: cell for column, cell in cells.items() if column not in names}
    block = read_back(tmp_path, [cells | {name: str(value)}])
    number = block.time_s[0] if row is None else block.measurement[0, row]
    assert number == pytest.approx(expected, rel=1e-14)


def test_times_in_milliseconds_equal_times_in_seconds(tmp_path):
    lines = [line | {"time_s": f"{100 * t}"} for t, line in enumerate(rows(50)[::L])]
    times = read_back(tmp_path, text(lines).replace("time_s", "time_ms")).time_s
    assert times.tolist() == [float(f"{t // 10}.{t % 10}") for t in range(50)]


@pytest.mark.parametrize("place", [slice(1), slice(2, 3), slice(3)], ids=str)
def test_odometry_and_doppler_spread_may_be_in_any_or_all_rows_of_an_epoch(tmp_path, place):
    values = {"doppler_spread_mps": "0.5", "speed_kmh": "7.2", "heading_deg": "270"}
    lines = [line | dict.fromkeys(values, "") for line in rows(2)]
    for line in lines[place]:
        line.update(values)
    block = read_back(tmp_path, lines)
    assert block.layout == Layout(L, odometry=True, partial=True)
    assert_allclose(block.measurement[0, -2:], [2.0, -np.pi / 2])
    assert block.visible[:, -1].tolist() == [True, False]
    assert_allclose(block.doppler_spread_hz, [0.5 * SCENE.hz_per_mps, 0.0])


def test_columns_of_odometry_can_be_ignored(tmp_path):
    lines = [line | {"speed_mps": "fast"} for line in rows(2)]
    block = read_back(tmp_path, lines, odometry=False)
    assert block.layout == Layout(L, partial=True) and block.visible.all()


def test_anchors_may_be_missing_and_in_any_order(tmp_path):
    lines = rows(3)
    shuffled = [lines[2], lines[0], lines[1], lines[4], lines[8], lines[6]]
    block = read_back(tmp_path, shuffled)
    whole = read_back(tmp_path, lines, "w.csv")
    links = [[True] * 3, [False, True, False], [True, False, True]]
    assert_array_equal(block.visible[:, :L], links)
    assert_array_equal(block.visible[:, L], [True, False, True])
    keep = shown(block)
    assert_array_equal(block.measurement[keep], whole.measurement[keep])
    assert_array_equal(block.snr_db, np.where(links, whole.snr_db, -np.inf))
    assert not block.incomplete.any()


LINK_COLUMNS = ("toa_s", "aoa_azimuth_rad", "aoa_elevation_rad", "aod_azimuth_rad")


@pytest.mark.parametrize("empty", ["", "NaN", " ", "-nan"])
@pytest.mark.parametrize("column", [*LINK_COLUMNS, "snr_db"])
def test_a_link_that_lacks_a_value_is_incomplete(tmp_path, column, empty):
    lines = rows(2)
    lines[0][column] = lines[4][column] = empty
    block = read_back(tmp_path, lines).whole()
    wrong = np.zeros((2, 4), bool)
    wrong[0, 0] = wrong[1, 1] = True
    wrong[0, 3] = column == "snr_db"  # the Doppler shift's noise follows from the SNR
    assert_array_equal(block.incomplete, wrong)
    assert_array_equal(block.visible, ~wrong)


def test_a_doppler_shift_needs_only_the_snr_of_its_link(tmp_path):
    lines = rows(2)
    lines[0].update(dict.fromkeys(LINK_COLUMNS, ""))
    block = read_back(tmp_path, lines)
    assert block.visible[0].tolist() == [False, True, True, True]
    assert not block.incomplete.any()  # a link without any value is missing, not incomplete


def numbered(content, name):
    """Return a log's text with a first column that has this name and numbers of rows."""
    first, *lines = content.rstrip().split("\n")
    return "\n".join([f"{name},{first}", *(f'"{n}",{line}' for n, line in enumerate(lines))])


VARIANTS = {
    "CRLF": lambda s: s.replace("\n", "\r\n"),
    "BOM": lambda s: "\ufeff" + s,
    "no last newline": lambda s: s.rstrip("\n"),
    "blank end": lambda s: s + "\n\n",
    "blank lines": lambda s: s.replace("\n1,", "\n \n1,"),
    "spaces": lambda s: s.replace(",", " , "),
    "semicolons": lambda s: s.replace(",", ";"),
    "quoted header": lambda s: '"' + HEADER.replace(",", '","') + '"' + s[len(HEADER) :],
    "quoted cells": lambda s: '"' + s.replace(",", '","').replace("\n", '"\n"')[:-1],
    "decimal commas": lambda s: s.replace(",", ";").replace(".", ","),
    "numbered rows": lambda s: numbered(s, ""),
    "Unnamed: 0": lambda s: numbered(s, "Unnamed: 0"),
    "delimiters without cells": lambda s: s.replace("\n", ",,\n"),
    "delimiters in rows": lambda s: HEADER + s.replace("\n", ",\n")[len(HEADER) + 1 :],
    "rows without cells": lambda s: s.replace("\n1,", "\n,,,,,,,\n1,"),
    "NA": lambda s: s.replace(",,", ",NA,"),
    "anchor 1.0": lambda s: s.replace("\n0,1,", "\n0.0,1.0,"),
    "other order": lambda s: "".join(",".join(line.split(",")[::-1]) + "\n" for line in s.split()),
}


@pytest.mark.parametrize("unit", ["s", "ms"])
@pytest.mark.parametrize("moment", [
    "2026-11-20T09:15:0{}.25Z", "2026-11-20 10:15:0{}.250000000+01:00", "20261120T09150{},25"
])  # fmt: skip
def test_dates_become_seconds_since_1970_in_files_and_live(tmp_path, moment, unit):
    lines = [line | {"time_s": f'"{moment.format(line["time_s"])}"'} for line in rows()]
    content = text(lines).replace("time_s", f"time_{unit}")
    log = read_back(tmp_path, content)
    assert_array_equal(log.time_s, 1_795_166_100.25 + np.arange(4))
    assert_same(read_live(content)[0], log, "line")


def test_equal_rows_are_left_out_and_counted_in_files_and_live(tmp_path):
    lines = rows()
    twice = [lines[0], lines[1], lines[0], *lines[2:6], lines[5], lines[4], *lines[6:]]
    with pytest.warns(UserWarning, match=r"left out: repeated rows: 3 \(line 4\)"):
        log = read_back(tmp_path, twice)
    assert_same(log, read_back(tmp_path, lines, "once.csv"), "line")
    live, warnings = read_live(text(twice))
    assert_same(live, log, "line")
    assert warnings == ["left out: repeated rows (line 4)"]


@pytest.mark.parametrize("name", VARIANTS)
def test_separators_line_ends_and_the_order_of_columns_do_not_change_what_is_read(tmp_path, name):
    plain = text(rows())
    other = VARIANTS[name](text(rows()))
    assert other != plain
    same = read_back(tmp_path, other, "other.csv")
    expected = read_back(tmp_path, plain)
    assert_same(same, expected, "line")
    assert_same(read_live(other)[0], expected, "line")


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=15)
@given(
    seed=st.integers(0, 50),
    odometry=st.booleans(),
    hidden=st.integers(0, 2**32 - 1),
)
def test_an_episode_written_to_a_log_is_read_back(suffix, seed, odometry, hidden):
    require_pyarrow(suffix)
    true = episode(seed, odometry=odometry)
    mask = np.random.default_rng(hidden).random(true.visible.shape) < 0.8
    true = replace(true, visible=true.visible & mask)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        write_log(path, true)
        block = read(path).whole()
    assert block.layout == true.layout
    assert_array_equal(block.time_s, true.time_s)
    assert_array_equal(block.visible, true.usable)
    assert_array_equal(block.doppler_spread_hz, true.doppler_spread_hz)
    assert not block.incomplete.any()
    keep = shown(block)
    z = np.where(keep, block.measurement, 0.0)
    expected = np.where(keep, true.measurement, 0.0)
    assert_allclose(z, expected, rtol=1e-15)
    z[:, 0 : true.layout.doppler : 4] = expected[:, 0 : true.layout.doppler : 4]
    assert_array_equal(z, expected)  # all values but ranges are stored without rounding
    needed = true.usable[:, :L].copy()
    needed[:, 0] |= true.usable[:, L]
    assert_array_equal(block.snr_db, np.where(needed, true.snr_db, -np.inf))


def test_links_with_nan_are_not_written_and_elevations_past_the_vertical_become_vertical(tmp_path):
    true = episode(1)
    measurement = true.measurement.copy()
    measurement[4, 1] = np.nan
    measurement[[1, 2], 2] = 1.6, -1.6
    path = tmp_path / "log.csv"
    write_log(path, replace(true, measurement=measurement, visible=np.ones_like(true.visible)))
    block = read(path)
    assert not block.visible[4, 0] and block.visible[4, 3] and not block.incomplete.any()
    assert block.measurement[[1, 2], 2].tolist() == [np.pi / 2, -np.pi / 2]


CORRECTED = replace(
    SCENE,
    bearing_deg=10.0,
    range_offset_m=(1.0, 2.0, 3.0),
    range_offset_sigma_m=(0.3, 0.0, 0.4),
)


def test_the_corrections_of_a_scene_are_subtracted_from_ranges_and_azimuths(tmp_path):
    path = store(tmp_path, rows())
    expected = read(path).measurement
    expected[:, 0:12:4] -= [1.0, 2.0, 3.0]
    for row in (1, 3):
        expected[:, row:12:4] = wrapped(expected[:, row:12:4] - np.radians(10.0))
    assert_allclose(read(path, CORRECTED).measurement, expected, rtol=1e-12)


def test_a_departure_relative_to_the_body_has_no_bearing(tmp_path):
    lines = [line | {"heading_deg": "30", "speed_mps": "1"} for line in rows()]
    path = store(tmp_path, in_body(text(lines)))
    plain = read(path).measurement
    corrected = read(path, CORRECTED).measurement
    assert_array_equal(corrected[:, 3:12:4], plain[:, 3:12:4])
    assert not np.allclose(corrected[:, 1:12:4], plain[:, 1:12:4])


def test_the_uncertainty_of_offsets_adds_to_own_and_modelled_noise(tmp_path):
    lines = [line | {"range_sigma_m": "0.4"} for line in rows()]
    log = read_back(tmp_path, lines, scene=CORRECTED)
    own = np.hypot(0.4, [0.3, 0.0, 0.4])
    assert_allclose(log.sigma[:, 0:12:4], np.tile(own, (len(log), 1)))
    snr = np.full((1, L), 20.0)
    plain = RADIOS["standard"].sigma(snr, SCENE, log.layout)[0]
    noisy = RADIOS["standard"].sigma(snr, CORRECTED, log.layout)[0]
    assert_allclose((noisy**2 - plain**2)[0:12:4], [0.09, 0.0, 0.16], atol=1e-12)
    assert_array_equal(noisy[1:4], plain[1:4])


def test_live_rows_are_corrected_like_those_of_a_file(tmp_path):
    content = text(rows())
    header, *lines = content.rstrip().split("\n")
    live = LiveLog(header.split(","), CORRECTED)
    epochs = [epoch for line in lines for epoch in live.add(line)]
    assert all(epoch.columns.placed(epoch.rows) is None for epoch in epochs)
    log = log_from([*epochs, *live.end_epoch()])
    assert_same(log, read_back(tmp_path, content, scene=CORRECTED), "line")


# --- formulas of docs/data.md, which convert angles of other conventions to ours

PAGE = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
TABLE = PAGE.split("<!-- conversions:")[1].split("<!-- end of conversions")[0]
CONVERSIONS = [  # for each row: a description, then formulas of arrival, elevation and departure
    [cell.strip(" `") for cell in row.strip("|").split("|")]
    for row in TABLE.splitlines()
    if row.startswith("| ") and "you have" not in row
]


def between(p, q):
    """Return azimuth and elevation, in degrees, of the direction from p to q."""
    d = np.subtract(q, p)
    return np.degrees(np.arctan2(d[1], d[0])), np.degrees(np.arctan2(d[2], np.hypot(d[0], d[1])))


def reported(anchor, user):
    """Return a dict for each row: the angles (deg) that a receiver of this convention reports."""
    out, elevation = between(anchor, user)
    back, at_user = between(user, anchor)
    return [
        {"arrival": back, "elevation": at_user, "departure": out},
        {"zenith": 90.0 - elevation},
        {"arrival": 63.0 - out, "departure": 63.0 - back, "x_axis": 63.0},
        {"arrival": out - 25.0, "anchor_yaw": 25.0, "departure": back + 70.0, "user_yaw": -70.0},
    ]


@pytest.mark.parametrize("user", [(30.0, 9.0, 1.5), (-20.0, -4.0, 1.5), (3.0, -40.0, 12.0)])
def test_every_conversion_on_the_page_gives_our_angles(user):
    anchor = (1.0, 2.0, 10.0)
    rows = exact_rows(user, [0.0] * 3, [anchor], 1.0, Layout(1))
    right = np.degrees(rows[1:4])
    receivers = reported(anchor, user)
    assert len(CONVERSIONS) == len(receivers)
    for (_, *formulas), names in zip(CONVERSIONS, receivers, strict=True):
        for formula, angle in zip(formulas, right, strict=True):
            if formula:
                turn = eval(formula, {}, names) - angle
                assert (turn + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9), formula
