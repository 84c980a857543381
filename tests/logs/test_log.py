"""Measurement logs: what is read, in which units, and what is refused where."""

import gzip
import re
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.datasets.log_writer import log_columns, log_text, write_log
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.logs.log_columns import QUANTITIES
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.measurement import SPEED_OF_LIGHT, Layout
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES, Scene
from mmwave_env.world.simulated import SimulatedSource

SCENE = SCENES["street"]
L = 3
HEADER = ("time_s,anchor,toa_s,aoa_azimuth_rad,aoa_elevation_rad,aod_azimuth_rad,doppler_hz,"
          "snr_db")  # fmt: skip
TIME, ANCHOR, TOA, AOA, ELEVATION, AOD, DOPPLER, SNR = range(8)
PER_EPOCH = LogBlock.per_epoch
SUFFIXES = (".csv", ".csv.gz", ".parquet")


def rows(epochs=4, first=0):
    """Lines of cells, one for each epoch and anchor, all numbers different."""
    out = []
    for t in range(first, first + epochs):
        for a in range(1, L + 1):
            doppler = f"{t + 0.5}" if a == 1 else ""
            out.append([f"{t}", f"{a}", f"{t + a}e-7", f"0.{a}{t}", f"-0.{a}", f"{a - 2}.{t}",
                        doppler, f"{20 + a}"])  # fmt: skip
    return out


def text(lines, header=HEADER):
    return "\n".join([header, *(",".join(line) for line in lines)]) + "\n"


def store(folder, content, name="log.csv"):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(path, scene=SCENE, **options):
    return joined(list(read_log(path, scene, **options)))


def joined(blocks):
    return replace(
        blocks[-1], **{f: np.concatenate([getattr(b, f) for b in blocks]) for f in PER_EPOCH}
    )


def delivered(path, scene=SCENE, **options):
    """The blocks before the error, and the error."""
    blocks = []
    with pytest.raises(LogError) as error:
        blocks.extend(read_log(path, scene, **options))
    # extend() keeps what came before the error
    return blocks, str(error.value)


def shown(block):
    """(T, rows) whether a row is visible."""
    widths = [group.stop - group.start for group in block.layout.groups]
    return np.repeat(block.visible, widths, axis=1)


@lru_cache
def episode(seed=0, epochs=25, odometry=False, radio="handset"):
    source = SimulatedSource(SCENE, RADIOS[radio], "mixed", epochs=epochs, odometry=odometry)
    return source.sample(np.random.default_rng(seed))


def require_pyarrow(suffix=".parquet"):
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")


# --- what is read


def test_every_number_has_its_place(tmp_path):
    block = read(store(tmp_path, text(rows())))
    assert block.layout == Layout(L) and len(block) == 4
    np.testing.assert_array_equal(block.time_s, [0.0, 1.0, 2.0, 3.0])
    assert block.visible.all() and not block.incomplete.any()
    np.testing.assert_allclose(block.measurement[2, 4], 4e-7 * SPEED_OF_LIGHT, rtol=1e-15)
    np.testing.assert_allclose(block.measurement[2, 5:8], [0.22, -0.2, 0.2], rtol=1e-14)
    np.testing.assert_array_equal(block.measurement[:, -1], [0.5, 1.5, 2.5, 3.5])
    np.testing.assert_array_equal(block.snr_db, np.tile([21.0, 22.0, 23.0], (4, 1)))
    np.testing.assert_array_equal(block.doppler_spread_hz, np.zeros(4))
    assert block.rows == 12 and block.share == 1.0


@pytest.mark.parametrize("suffix", ["rad", "deg"])
def test_arrivals_as_the_base_station_sees_them_are_mirrored(tmp_path, suffix):
    ours = episode(epochs=5)
    columns = log_columns(ours)
    path, station = tmp_path / "station.csv", SCENE.anchors_m[0]
    azimuth, elevation = columns.pop("aoa_azimuth_rad"), columns["aoa_elevation_rad"]
    images = SCENE.anchors_m[columns["anchor"].astype(int) - 1]
    n = images - station
    n /= np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]
    d = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
                  np.sin(elevation)], axis=1)  # fmt: skip
    d -= 2.0 * (d * n).sum(axis=1)[:, None] * n  # what the wall makes of it is what there was
    seen = np.arctan2(d[:, 1], d[:, 0])
    columns[f"aoa_azimuth_station_{suffix}"] = np.degrees(seen) if suffix == "deg" else seen
    columns["aoa_elevation_rad"] = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1]))
    path.write_text(log_text(columns))
    write_log(tmp_path / "image.csv", ours)
    one, two = read(path), read(tmp_path / "image.csv")
    np.testing.assert_array_equal(one.visible, two.visible)
    np.testing.assert_allclose(one.measurement, two.measurement, rtol=1e-9, equal_nan=True)


BODY = HEADER.replace("aod_azimuth_rad", "aod_azimuth_body_deg")


@pytest.mark.parametrize("odometry", [True, False])
@pytest.mark.parametrize("columns", [",heading_deg", ",speed_mps,heading_deg"])
def test_departures_in_the_frame_of_the_body_are_turned_by_the_heading(tmp_path, columns, odometry):
    lines = rows(2)
    for line, heading in zip(lines, ("", "170", "", "-40", "", "-40"), strict=True):
        line[AOD] = "20.0"
        line += ["1.5", heading] if "speed" in columns else [heading]
    block = read(store(tmp_path, text(lines, BODY + columns)), odometry=odometry)
    departures = np.degrees(block.measurement[:, 3:12:4])  # of a row, by the heading of its epoch
    np.testing.assert_allclose(departures, [[-170.0] * 3, [-20.0] * 3])
    assert block.visible.all()
    assert block.layout == Layout(L, odometry and "speed" in columns)


def test_a_departure_of_a_body_without_heading_is_empty(tmp_path):
    lines = [[*line, "90" if line[TIME] == "1" else ""] for line in rows(2)]
    block = read(store(tmp_path, text(lines, BODY + ",heading_deg")))
    np.testing.assert_array_equal(block.visible[:, :L], [[False] * 3, [True] * 3])
    np.testing.assert_array_equal(block.incomplete[:, :L], [[True] * 3, [False] * 3])


@pytest.mark.parametrize(
    ("name", "value", "row", "expected"),
    [
        ("time_s", "1.5", None, 1.5),
        ("time_ms", "1500", None, 1.5),
        ("time_us", "1.5e6", None, 1.5),
        ("time_ns", "1500000000", None, 1.5),
        ("toa_s", "1e-7", 0, 29.9792458),
        ("toa_ms", "1e-4", 0, 29.9792458),
        ("toa_us", "0.1", 0, 29.9792458),
        ("toa_ns", "100", 0, 29.9792458),
        ("range_m", "29.9792458", 0, 29.9792458),
        ("aoa_azimuth_rad", "-1.5", 1, -1.5),
        ("aoa_azimuth_deg", "-90", 1, -np.pi / 2),
        ("aoa_azimuth_deg", "270", 1, -np.pi / 2),
        ("aoa_azimuth_deg", "180", 1, -np.pi),
        ("aoa_elevation_deg", "45", 2, np.pi / 4),
        ("aod_azimuth_deg", "-270", 3, np.pi / 2),
        ("doppler_hz", "-934.0", 12, -934.0),
        ("doppler_khz", "-0.934", 12, -934.0),
        ("doppler_mps", "2.0", 12, 2.0 * 28e9 / SPEED_OF_LIGHT),
    ],
)
def test_units_are_converted(tmp_path, name, value, row, expected):
    (quantity,) = [q for q, names in QUANTITIES.items() if name in names]
    cells = dict.fromkeys(HEADER.split(","), "0.5") | {
        "time_s": "1",
        "anchor": "1",
        "toa_s": "1e-7",
    }
    (old,) = [column for column in cells if column in QUANTITIES[quantity]]
    del cells[old]
    cells[name] = value
    path = store(tmp_path, f"{','.join(cells)}\n{','.join(cells.values())}\n")
    block = read(path)
    found = block.time_s[0] if row is None else block.measurement[0, row]
    assert found == pytest.approx(expected, rel=1e-14)


def test_milliseconds_are_the_same_times_as_seconds(tmp_path):
    lines = [[f"{100 * t}", "1", "1e-7", "0", "0", "0", "", "20"] for t in range(50)]
    times = read(store(tmp_path, text(lines, HEADER.replace("time_s", "time_ms")))).time_s
    assert times.tolist() == [float(f"{t // 10}.{t % 10}") for t in range(50)]


@pytest.mark.parametrize("place", [0, 1, 2])
def test_odometry_and_spread_may_stand_in_any_row(tmp_path, place):
    header = HEADER + ",doppler_spread_mps,speed_kmh,heading_deg"
    lines = [[*line, "", "", ""] for line in rows(2)]
    lines[place][-3:] = ["0.5", "7.2", "270"]
    block = read(store(tmp_path, text(lines, header)))
    assert block.layout == Layout(L, odometry=True)
    np.testing.assert_allclose(block.measurement[0, -2:], [2.0, -np.pi / 2])
    assert block.visible[:, -1].tolist() == [True, False]
    np.testing.assert_allclose(block.doppler_spread_hz, [0.5 * SCENE.hz_per_mps, 0.0])


def test_odometry_in_every_row_is_read_once(tmp_path):
    lines = [[*line, "1.5", "0.25"] for line in rows(2)]
    block = read(store(tmp_path, text(lines, HEADER + ",speed_mps,heading_rad")))
    np.testing.assert_array_equal(block.measurement[:, -2:], [[1.5, 0.25]] * 2)


def test_odometry_can_be_left_alone(tmp_path):
    lines = [[*line, "fast"] for line in rows(2)]  # not even looked at
    block = read(store(tmp_path, text(lines, HEADER + ",speed_mps")), odometry=False)
    assert block.layout == Layout(L) and block.visible.all()


def test_half_an_odometry_is_incomplete(tmp_path):
    lines = [[*line, "1.5", ""] for line in rows(2)]
    block = read(store(tmp_path, text(lines, HEADER + ",speed_mps,heading_rad")))
    assert not block.visible[:, -1].any() and block.incomplete[:, -1].all()


def test_anchors_may_be_missing_and_in_any_order(tmp_path):
    lines = rows(3)
    shuffled = [lines[2], lines[0], lines[1], lines[4], lines[8], lines[6]]
    block, whole = (
        read(store(tmp_path, text(shuffled))),
        read(store(tmp_path, text(lines), "w.csv")),
    )
    seen = [[True] * 3, [False, True, False], [True, False, True]]
    np.testing.assert_array_equal(block.visible[:, :L], seen)
    np.testing.assert_array_equal(block.visible[:, L], [True, False, True])
    keep = shown(block)
    np.testing.assert_array_equal(block.measurement[keep], whole.measurement[keep])
    np.testing.assert_array_equal(block.snr_db, np.where(seen, whole.snr_db, -np.inf))
    assert not block.incomplete.any()


@pytest.mark.parametrize("empty", ["", "nan", "NaN", " ", "-nan"])
@pytest.mark.parametrize("column", [TOA, AOA, ELEVATION, AOD, SNR])
def test_a_link_without_all_its_numbers_is_incomplete(tmp_path, column, empty):
    lines = rows(2)
    lines[0][column] = lines[4][column] = empty
    block = read(store(tmp_path, text(lines)))
    wrong = np.zeros((2, 4), bool)
    wrong[0, 0] = wrong[1, 1] = True
    wrong[0, 3] = column == SNR  # the noise of the Doppler shift follows from it
    np.testing.assert_array_equal(block.incomplete, wrong)
    np.testing.assert_array_equal(block.visible, ~wrong)


def test_doppler_needs_no_link_but_its_snr(tmp_path):
    lines = rows(2)
    for column in (TOA, AOA, ELEVATION, AOD):
        lines[0][column] = ""
    block = read(store(tmp_path, text(lines)))
    assert block.visible[0].tolist() == [False, True, True, True]
    assert not block.incomplete.any()  # a link of which nothing was measured is just missing


def test_without_doppler_it_is_missing(tmp_path):
    path = store(tmp_path, text([line[:DOPPLER] + line[SNR:] for line in rows(2)],
                                HEADER.replace("doppler_hz,", "")))  # fmt: skip
    block = read(path)
    assert block.visible[:, :L].all() and not block.visible[:, L].any()


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s.replace("\n", "\r\n"),
        lambda s: "\ufeff" + s,
        lambda s: s.rstrip("\n"),
        lambda s: s + "\n\n",
        lambda s: s.replace("\n1,", "\n \n1,"),
        lambda s: s.replace(",", " , "),
        lambda s: '"' + HEADER.replace(",", '","') + '"' + s[len(HEADER) :],
        lambda s: s.replace("\n0,1,", "\n0.0,1.0,"),
    ],
    ids=["CRLF", "BOM", "no last newline", "blank end", "blank lines", "spaces", "quoted header",
         "anchor 1.0"],
)  # fmt: skip
def test_spellings_of_csv(tmp_path, change):
    plain, other = text(rows()), change(text(rows()))
    assert other != plain
    one, two = read(store(tmp_path, plain)), read(store(tmp_path, other, "other.csv"))
    for field in PER_EPOCH:
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))


def test_columns_may_stand_in_any_order(tmp_path):
    order = [7, 2, 0, 6, 1, 3, 5, 4]
    header = ",".join(HEADER.split(",")[i] for i in order)
    lines = [[line[i] for i in order] for line in rows()]
    one, two = (
        read(store(tmp_path, text(rows()))),
        read(store(tmp_path, text(lines, header), "o.csv")),
    )
    for field in PER_EPOCH:
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))


def test_one_anchor_is_enough(tmp_path):
    scene = Scene("alone", (0.0, 0.0, 5.0))
    block = read(store(tmp_path, text(rows()[::3])), scene)
    assert block.layout == Layout(1) and block.visible.all() and block.measurement.shape == (4, 5)


# --- there and back


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 50),
    odometry=st.booleans(),
    size=st.integers(1, 30),
    hidden=st.integers(0, 2**32 - 1),
)
def test_an_episode_survives_a_file(suffix, seed, odometry, size, hidden):
    require_pyarrow(suffix)
    true = episode(seed, odometry=odometry)
    mask = np.random.default_rng(hidden).random(true.visible.shape) < 0.8
    true = replace(true, visible=true.visible & mask)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"log{suffix}"
        write_log(path, true)
        blocks = list(read_log(path, SCENE, epochs_per_block=size))
    assert [len(b) for b in blocks[:-1]] == [size] * (len(blocks) - 1)
    assert 1 <= len(blocks[-1]) <= size
    found = joined(blocks)
    assert found.layout == true.layout
    np.testing.assert_array_equal(found.time_s, true.time_s)
    np.testing.assert_array_equal(found.visible, true.usable)
    np.testing.assert_array_equal(found.doppler_spread_hz, true.doppler_spread_hz)
    assert not found.incomplete.any()
    keep = shown(found)
    ranges = np.zeros_like(keep)
    ranges[:, 0 : true.layout.doppler : 4] = True
    np.testing.assert_array_equal(
        found.measurement[keep & ~ranges], true.measurement[keep & ~ranges]
    )
    np.testing.assert_allclose(
        found.measurement[keep & ranges], true.measurement[keep & ranges], rtol=1e-15
    )
    needed = true.usable[:, :L].copy()
    needed[:, 0] |= true.usable[:, L]
    np.testing.assert_array_equal(found.snr_db, np.where(needed, true.snr_db, -np.inf))


def test_what_is_read_makes_an_episode(tmp_path):
    true = episode(3)
    path = tmp_path / "log.csv"
    write_log(path, true)
    block = read(path)
    sigma = RADIOS["handset"].sigma(block.snr_db, SCENE, block.layout)
    found = replace(true, measurement=block.measurement, sigma=sigma, visible=block.visible,
                    snr_db=block.snr_db, doppler_spread_hz=block.doppler_spread_hz)  # fmt: skip
    np.testing.assert_array_equal(found.usable, true.usable)
    np.testing.assert_allclose(found.table(), true.table(), rtol=1e-14)


def test_numbers_that_cannot_be_used_are_not_written(tmp_path):
    true = episode(1)
    measurement = true.measurement.copy()
    measurement[4, 1] = np.nan
    path = tmp_path / "log.csv"
    write_log(path, replace(true, measurement=measurement, visible=np.ones_like(true.visible)))
    block = read(path)
    assert not block.visible[4, 0] and block.visible[4, 3] and not block.incomplete.any()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_elevation_that_noise_pushes_past_the_vertical_is_written_as_one_that_is_read(
    tmp_path, sign
):
    true = episode(1)
    measurement, visible = true.measurement.copy(), true.visible.copy()
    measurement[1, 2], visible[1, 0] = sign * 1.6, True
    path = tmp_path / "log.csv"
    write_log(path, replace(true, measurement=measurement, visible=visible))
    assert read(path).measurement[1, 2] == sign * np.pi / 2


def test_a_file_is_written_alike_every_time(tmp_path):
    for name in ("one.csv.gz", "two.csv.gz"):
        write_log(tmp_path / name, episode())
    one, two = ((tmp_path / name).read_bytes() for name in ("one.csv.gz", "two.csv.gz"))
    assert one == two and gzip.decompress(one).decode() == log_text(log_columns(episode()))


# --- what is refused


def edit(row, column, value):
    """Change one cell; rows count from 0, so row r is line r + 2."""

    def change(lines):
        lines[row][column] = value

    return change


DAMAGE = {  # change, message, epochs delivered
    "not a number": (edit(7, SNR, "good"), "line 9, column 'snr_db': found 'good'.*number", 2),
    "quotes": (edit(7, SNR, '"1"'), "line 9, column 'snr_db': found '\"1\"'", 2),
    "underscore": (edit(7, SNR, "1_0"), "line 9, column 'snr_db': found '1_0'", 2),
    "NUL": (edit(7, TOA, "1\0"), r"line 9, column 'toa_s': found '1\\x00'", 2),
    "not UTF-8": (edit(7, AOD, "1\udcff"), r"line 9, column 'aod_azimuth_rad': .*xff", 2),
    "inf": (edit(7, AOA, "inf"), "line 9, column 'aoa_azimuth_rad': found inf.*finite", 2),
    "overflow": (edit(7, AOA, "1e999"), "line 9.*found inf.*finite", 2),
    "minus inf": (edit(6, DOPPLER, "-inf"), "line 8, column 'doppler_hz': found -inf", 2),
    "no time": (edit(7, TIME, ""), "line 9, column 'time_s': found nothing.*every row", 2),
    "infinite time": (edit(7, TIME, "inf"), "line 9, column 'time_s': found inf", 2),
    "infinite time again": (edit(6, TIME, "inf"), "line 8, column 'time_s': found inf", 2),
    "time back": (edit(7, TIME, "1"), "line 9, column 'time_s': found 1 after 2.*increase", 2),
    "first row": (edit(0, ANCHOR, "x"), "line 2, column 'anchor': found 'x'", 0),
    "second row": (edit(1, TIME, "-1"), "line 3, column 'time_s': found -1 after 0", 0),
    "no anchor": (edit(7, ANCHOR, ""), "line 9, column 'anchor': found nothing.*1 to 3", 2),
    "anchor 0": (edit(7, ANCHOR, "0"), "line 9, column 'anchor': found 0, .*1 to 3", 2),
    "anchor 4": (edit(7, ANCHOR, "4"), "line 9, column 'anchor': found 4, .*1 to 3", 2),
    "anchor 1.5": (edit(7, ANCHOR, "1.5"), "line 9, column 'anchor': found 1.5,", 2),
    "same anchor": (edit(8, ANCHOR, "2"), "line 10, column 'anchor': found 2 a second time", 2),
    "negative toa": (edit(7, TOA, "-1e-9"), "line 9, column 'toa_s': found -1e-09.*at least 0", 2),
    "zenith angle": (edit(7, ELEVATION, "1.67"), "line 9, column 'aoa_elevation_rad': found 1.67, "
                     "which is 95.7 degrees, expected -90 to 90 degrees from the horizon", 2),
    "azimuth for elevation": (
        edit(7, ELEVATION, "-3"), "found -3, which is -172 degrees, .*aoa_elevation_deg; if it is "
        "the azimuth, exchange aoa_azimuth_rad with it; mmwave-loc localize --diagnose", 2),
    "degrees": (edit(7, AOD, "-57.3"), "line 9, column 'aod_azimuth_rad': found -57.3, which is "
                "-3.28e.03 degrees, expected -360 to 360 degrees .docs/data.md, Angles.", 2),
    "doppler of no user": (edit(6, DOPPLER, "1e308"), "line 8, column 'doppler_hz': found 1e.308, "
                           "which is 1e.308 Hz, expected a number of -1e.07 to 1e.07 Hz", 2),
    "SNR of no receiver": (edit(7, SNR, "-1e4"), "'snr_db': found -10000.*-1000 to 1000 dB", 2),
    "a moment later": (edit(6, TIME, "1.0000000001"), "line 8, column 'time_s': found 1e-10 s "
                       "after the row before, expected the time of that row, or at least 1e-06", 2),
    "doppler of anchor 2": (edit(7, DOPPLER, "3"), "line 9, column 'doppler_hz': found 3.*1", 2),
    "short row": (lambda lines: lines[7].pop(), "line 9: found 7 cells, expected 8", 2),
    "long row": (lambda lines: lines[7].append("1"), "line 9: found 9 cells, expected 8", 2),
    "one cell": (lambda lines: lines.insert(7, ["xyz"]), "line 9: found one cell, 'xyz'", 2),
    "NULs": (lambda lines: lines.insert(9, ["\0" * 90]), "line 11: found one cell.*x00", 3),
    "last row": (lambda lines: lines[11].pop(), "line 13: found 7 cells, expected 8", 3),
    "row too many": (lambda lines: lines.append(list(lines[9])), "line 14.*a second time", 3),
    "first of two": (lambda lines: (edit(7, TOA, "-1")(lines), edit(10, SNR, "x")(lines)),
                     "line 9, column 'toa_s'", 2),
    "text before": (lambda lines: (edit(7, SNR, "x")(lines), edit(10, TOA, "-1")(lines)),
                    "line 9, column 'snr_db'", 2),
}  # fmt: skip


@pytest.mark.parametrize("size", [1, 3, 1000])
@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_row_is_named_and_what_came_before_delivered(tmp_path, name, size):
    assert_named_and_delivered(tmp_path, name, size)


@pytest.mark.parametrize("name", DAMAGE)
@pytest.mark.parametrize("table_bytes", [100, 150, 190])
def test_damage_is_found_wherever_the_file_is_cut(tmp_path, monkeypatch, name, table_bytes):
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", table_bytes)
    assert_named_and_delivered(tmp_path, name, 2)


def assert_named_and_delivered(tmp_path, name, size):
    change, message, epochs = DAMAGE[name]
    lines = rows()
    change(lines)
    path = store(tmp_path, text(lines).encode("utf-8", "surrogateescape"))
    blocks, error = delivered(path, epochs_per_block=size)
    assert error.startswith(f"{path}, ") and "expected" in error
    assert re.search(message, error), error
    assert sum(map(len, blocks)) == epochs
    if blocks:
        whole = read(store(tmp_path, text(rows()), "whole.csv"))
        for field in PER_EPOCH:
            np.testing.assert_array_equal(
                getattr(joined(blocks), field), getattr(whole, field)[:epochs]
            )


@pytest.mark.parametrize("angle", [np.pi / 2, -np.pi / 2, float(np.float32(np.pi / 2))])
def test_straight_up_and_down_are_elevations(tmp_path, angle):
    lines = rows()
    edit(7, ELEVATION, repr(angle))(lines)
    assert read(store(tmp_path, text(lines))).measurement[2, 6] == angle


def test_without_limits_numbers_stay_as_they_are_found(tmp_path):
    lines = rows()
    for column, value in ((AOA, "57.3"), (ELEVATION, "95.7"), (AOD, "-360.5"), (TOA, "1.0")):
        edit(7, column, value)(lines)
    block = read(store(tmp_path, text(lines)), limits=False)
    np.testing.assert_allclose(block.measurement[2, 4:8], [SPEED_OF_LIGHT, 57.3, 95.7, -360.5])


def test_rows_of_an_epoch_that_are_apart_are_named(tmp_path):
    lines = rows()
    lines[4], lines[8] = lines[8], lines[4]
    blocks, error = delivered(store(tmp_path, text(lines)))
    assert re.search("line 7, column 'time_s': found 1 after 2.*rows of an epoch together", error)
    assert joined(blocks).time_s.tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("column", "cells", "message"),
    [
        ("doppler_spread_hz", ["1", "2", ""], "line 3.*'doppler_spread_hz': found 2 beside 1 at"),
        ("doppler_spread_hz", ["", "-1", ""], "line 3.*'doppler_spread_hz': found -1.*at least 0"),
        (
            "doppler_spread_hz",
            ["", "1e6", ""],
            "line 3.*found 1000000, .* to 100000 Hz, in the unit",
        ),
        ("speed_mps", ["", "2e4", ""], "line 3, column 'speed_mps': found 20000, .*10000 m/s"),
        ("speed_mps", ["", "1.5", "1.6"], "line 4, column 'speed_mps': found 1.6 beside 1.5 at"),
        ("heading_rad", ["", "x", ""], "line 3, column 'heading_rad': found 'x'"),
    ],
)
def test_numbers_of_an_epoch_are_checked(tmp_path, column, cells, message):
    columns = ["doppler_spread_hz", "speed_mps", "heading_rad"]
    lines = rows(1)
    for line, cell in zip(lines, cells, strict=True):
        line += [cell if name == column else "" for name in columns]
    path = store(tmp_path, text(lines, f"{HEADER},{','.join(columns)}"))
    blocks, error = delivered(path)
    assert not blocks and re.search(message, error), error


@settings(max_examples=60, deadline=None)
@given(
    row=st.integers(0, 74),
    column=st.integers(0, 8),
    cell=st.sampled_from(["x", "-inf", "1e999", "--1", "1.2.3", "0x10", "1,2", "\0", "é", None]),
    size=st.integers(1, 30),
    table_bytes=st.sampled_from([400, 1000, 1 << 20]),
)
def test_whatever_cell_is_damaged_the_epochs_before_are_delivered(
    row, column, cell, size, table_bytes
):
    true = episode(epochs=25)
    header, *lines = [line.split(",") for line in log_text(log_columns(true)).splitlines()]
    lines[row][column : column + 1] = [] if cell is None else [cell]
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", table_bytes)
        path = store(Path(folder), text(lines, ",".join(header)))
        blocks, error = delivered(path, epochs_per_block=size)
    assert re.match(rf"{re.escape(str(path))}, line {row + 2}[,:]", error)
    if cell not in (None, "1,2"):
        assert f"column {header[column]!r}" in error
    assert sum(map(len, blocks)) == row // L
    if blocks:
        found = joined(blocks)
        np.testing.assert_array_equal(found.visible, true.usable[: row // L])
        keep = shown(found)
        np.testing.assert_allclose(
            found.measurement[keep], true.measurement[: row // L][keep], rtol=1e-15
        )


HEADERS = {
    "empty": ("", "found an empty file"),
    "no columns": ("\n", "line 1: found '', expected names of columns, divided by commas"),
    "semicolons": (HEADER.replace(",", ";"), "line 1: found 'time_s;anchor.*divided by commas"),
    "no header": ("0,1,1e-7,0,0,0,1,20", "column '0': found no quantity we know"),
    "unknown": (HEADER + ",color", "column 'color'.*out of time_s, anchor, toa_s, .*snr_db"),
    "index": ("," + HEADER, "column '': found no quantity"),
    "no unit": (HEADER.replace("toa_s", "toa"), "column 'toa'.*toa_s, toa_ms, .* or range_m"),
    "no unit of range": (HEADER.replace("toa_s", "range"), "column 'range'.*or range_m"),
    "other unit": (HEADER.replace("toa_s", "toa_ps"), "column 'toa_ps'.*toa_ns or range_m"),
    "unit of another": (HEADER.replace("time_s", "time_rad"), "'time_rad'.*time_s, time_ms"),
    "snr": (HEADER.replace("snr_db", "snr"), "column 'snr': found no unit.*expected snr_db"),
    "spread": (HEADER + ",doppler_spread", "column 'doppler_spread'.*doppler_spread_hz,"),
    "anchor with unit": (HEADER.replace("anchor", "anchor_id"), "'anchor_id'.*expected anchor"),
    "twice": (HEADER + ",range_m", "found both 'toa_s' and 'range_m', expected toa once"),
    "the same twice": (HEADER + ",toa_s", "found 'toa_s' twice, expected toa once"),
    "speed alone": (HEADER + ",speed_mps", "found 'speed_mps' alone, expected heading.*_rad"),
    "zeros": (b"\0" * 90, "line 1: found '.x00|column '.x00"),
    "endless name": ("a" * 200_000 + "," + HEADER, "line 1: found 'aaa.*names of columns"),
    "heading alone": (HEADER + ",heading_deg", "found 'heading_deg' alone, expected speed"),
    "body without heading": (
        HEADER.replace("aod_azimuth", "aod_azimuth_body"),
        "found no heading in .*expected heading_rad or heading_deg, which turns the azimuth of dep",
    ),
    "arrivals twice": (
        HEADER + ",aoa_azimuth_station_deg",
        "found both 'aoa_azimuth_rad' and 'aoa_azimuth_station_deg', expected aoa_azimuth in one",
    ),
    "two frames": (
        HEADER + ",aod_azimuth_body_deg,heading_deg",
        "found both 'aod_azimuth_rad' and 'aod_azimuth_body_deg', expected aod_azimuth in one fr",
    ),
    "body with speed alone": (
        HEADER.replace("aod_azimuth", "aod_azimuth_body") + ",speed_mps",
        "found no heading in .*expected heading_rad",
    ),
    "not UTF-8": (b"time_s,\xff\xfe", r"column '.*xff.*xfe': found no quantity"),
} | {
    f"no {name}": (",".join(c for c in HEADER.split(",") if c != name), f"found no .*{name}")
    for name in HEADER.split(",")
    if name != "doppler_hz"
}  # fmt: skip


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_is_refused_at_once(tmp_path, name):
    content, message = HEADERS[name]
    path = store(tmp_path, content)
    with pytest.raises(LogError) as error:
        read_log(path, SCENE)
    assert str(error.value).startswith(str(path)) and re.search(message, str(error.value))


def test_every_missing_column_names_the_units_it_may_have(tmp_path):
    path = store(tmp_path, HEADER.replace(",aoa_azimuth_rad", ""))
    with pytest.raises(LogError, match="no aoa_azimuth in .*aoa_azimuth_rad or aoa_azimuth_deg"):
        read_log(path, SCENE)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER, "found a header and no rows without a measurement, expected at least one"),
        (text([["0", "1", "", "", "", "", "", ""]] * 1), "found 1 rows without a measurement"),
        (text([[f"{t}", "1"] + ["nan"] * 6 for t in range(9)]), "found 9 rows without"),
        (text([[f"{t}", "1", "1e-7"] + [""] * 5 for t in range(9)]), "9 groups with only some"),
    ],
)
def test_a_log_of_nothing_is_refused_at_its_end(tmp_path, content, message):
    path = store(tmp_path, content)
    _, error = delivered(path)
    assert error.startswith(str(path)) and message in error


@pytest.mark.parametrize("name", ["log.txt", "log", "log.csv.zip", "log.gz"])
def test_other_files_are_refused_by_name(tmp_path, name):
    with pytest.raises(LogError, match=r"expected a name in .csv, .csv.gz, .parquet"):
        read_log(store(tmp_path, text(rows()), name), SCENE)
    with pytest.raises(LogError, match=r"expected a name in .csv, .csv.gz, .parquet"):
        write_log(tmp_path / name, episode())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_that_are_not_there(tmp_path, suffix):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_log(tmp_path / f"nowhere{suffix}", SCENE)


def test_blocks_hold_at_least_an_epoch(tmp_path):
    with pytest.raises(ValueError, match="epochs_per_block: found 0, expected at least 1"):
        read_log(store(tmp_path, text(rows())), SCENE, epochs_per_block=0)


# --- broken files


def test_gzip_that_is_gigabytes_of_empty_lines(tmp_path):
    bomb = gzip.compress(text(rows(2)).encode() + b"\n" * 5_000_000, mtime=0)
    blocks, error = delivered(store(tmp_path, bomb, "log.csv.gz"))
    assert re.search(r"line \d+: found \d+ empty lines before it, expected rows", error)
    assert len(joined(blocks)) == 2


@pytest.mark.parametrize("left", [0.2, 0.5, 0.99])
def test_gzip_that_ends_too_early(tmp_path, left):
    true = episode(epochs=2000)
    packed = gzip.compress(log_text(log_columns(true)).encode(), mtime=0)
    path = store(tmp_path, packed[: int(left * len(packed))], "log.csv.gz")
    blocks, error = delivered(path, epochs_per_block=100)
    assert re.search(r"log.csv.gz, line \d+: found broken gzip data \(.*\), expected a file", error)
    found = joined(blocks)
    assert len(found) > (left - 0.1) * 2000
    np.testing.assert_array_equal(found.time_s, true.time_s[: len(found)])
    line = int(re.search(r"line (\d+)", error).group(1))
    assert len(found) == (line - 2) // L


@pytest.mark.parametrize("where", [2, 3, 5000, -6])
def test_gzip_with_a_wrong_byte(tmp_path, where):
    packed = bytearray(gzip.compress(log_text(log_columns(episode(epochs=2000))).encode(), mtime=0))
    packed[where] ^= 0xFF
    path = store(tmp_path, bytes(packed), "log.csv.gz")
    with pytest.raises(LogError, match="log.csv.gz"):
        list(read_log(path, SCENE))


def test_what_is_named_gzip_is_gzip(tmp_path):
    with pytest.raises(LogError, match=r"line 1: found broken gzip data .*Not a gzipped file"):
        read_log(store(tmp_path, text(rows()), "log.csv.gz"), SCENE)


def test_a_line_that_does_not_end(tmp_path):
    content = text(rows()).encode() + b"\0" * (3 << 20)
    blocks, error = delivered(store(tmp_path, content))
    assert re.search(r"line 14: found more than 1048576 bytes that begin with b'.x00", error)
    assert len(joined(blocks)) == 4


class TestParquet:
    @pytest.fixture(autouse=True)
    def arrow(self):
        self.arrow = pytest.importorskip("pyarrow")
        self.parquet = pytest.importorskip("pyarrow.parquet")

    def columns(self, **changes):
        lines = rows()
        names = HEADER.split(",")
        table = {name: [float(line[i]) if line[i] else None for line in lines]
                 for i, name in enumerate(names)}  # fmt: skip
        return table | changes

    def store(self, folder, columns, **options):
        path = folder / "log.parquet"
        self.parquet.write_table(self.arrow.table(columns), path, **options)
        return path

    def test_it_is_the_same_log(self, tmp_path):
        one = read(store(tmp_path, text(rows())))
        two = read(self.store(tmp_path, self.columns()))
        for field in PER_EPOCH:
            np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
        assert two.rows == 12 and two.share == 1.0

    @pytest.mark.parametrize("kind", ["int8", "int64", "float32", "decimal"])
    def test_types_of_numbers(self, tmp_path, kind):
        kind = self.arrow.decimal128(30, 1) if kind == "decimal" else getattr(self.arrow, kind)()
        anchor = self.arrow.array([1, 2, 3] * 4).cast(kind)
        empty = self.arrow.nulls(12)
        block = read(self.store(tmp_path, self.columns(anchor=anchor, doppler_hz=empty)))
        assert block.visible[:, :L].all() and not block.visible[:, L].any()

    @pytest.mark.parametrize("values", [["1"] * 12, [True] * 12, [[1.0]] * 12])
    def test_types_that_are_not_numbers(self, tmp_path, values):
        with pytest.raises(LogError, match=r"column 'snr_db': found type .*, expected numbers"):
            read_log(self.store(tmp_path, self.columns(snr_db=values)), SCENE)

    @pytest.mark.parametrize(
        ("column", "row", "value", "message", "epochs"),
        [
            ("anchor", 7, 9.0, "row 8, column 'anchor': found 9,.*1 to 3", 2),
            ("anchor", 7, None, "row 8, column 'anchor': found nothing", 2),
            ("time_s", 7, 0.0, "row 8, column 'time_s': found 0 after 2", 2),
            ("time_s", 6, None, "row 7, column 'time_s': found nothing", 2),
            ("toa_s", 2, -1.0, "row 3, column 'toa_s': found -1", 0),
            ("doppler_hz", 4, 1.0, "row 5, column 'doppler_hz': found 1", 1),
            ("snr_db", 11, float("inf"), "row 12, column 'snr_db': found inf", 3),
        ],
    )
    @pytest.mark.parametrize("batch", [2, 5, 1000])
    def test_damaged_rows(self, tmp_path, monkeypatch, column, row, value, message, epochs, batch):
        monkeypatch.setattr("mmwave_env.logs.log_tables._BATCH_ROWS", batch)
        columns = self.columns()
        columns[column][row] = value
        blocks, error = delivered(self.store(tmp_path, columns))
        assert re.search(message, error), error
        assert sum(map(len, blocks)) == epochs

    def test_missing_column(self, tmp_path):
        columns = self.columns()
        del columns["snr_db"]
        with pytest.raises(LogError, match=r"log.parquet: columns: found no snr in .*snr_db"):
            read_log(self.store(tmp_path, columns), SCENE)

    @pytest.mark.parametrize("left", [1, 100, -10])
    def test_a_file_that_ends_too_early(self, tmp_path, left):
        path = self.store(tmp_path, self.columns())
        path.write_bytes(path.read_bytes()[:left])
        with pytest.raises(LogError, match=r"log.parquet: found no readable Parquet"):
            read_log(path, SCENE)

    def test_names_of_columns_that_are_no_text_are_refused(self, tmp_path):
        path = self.store(tmp_path, self.columns(odd_note=[1.0] * len(rows())))
        path.write_bytes(path.read_bytes().replace(b"odd_note", b"odd\xffnote"))
        with pytest.raises(LogError, match=r"log.parquet: found (b'odd.xffnote'|no readable)"):
            read_log(path, SCENE)

    def test_what_is_named_parquet_is_parquet(self, tmp_path):
        with pytest.raises(LogError, match=r"log.parquet: found no readable Parquet"):
            read_log(store(tmp_path, text(rows()), "log.parquet"), SCENE)

    def test_an_empty_file(self, tmp_path):
        with pytest.raises(LogError, match="found an empty file"):
            read_log(store(tmp_path, "", "log.parquet"), SCENE)

    def test_broken_pages_after_good_ones(self, tmp_path, monkeypatch):
        monkeypatch.setattr("mmwave_env.logs.log_tables._BATCH_ROWS", 30)
        true = episode(epochs=200)
        path = tmp_path / "log.parquet"
        write_log(path, true)
        table = self.parquet.read_table(path)
        self.parquet.write_table(table, path, write_page_checksum=True, row_group_size=90,
                                 compression="none", use_dictionary=False)  # fmt: skip
        content = bytearray(path.read_bytes())
        middle = len(content) // 2
        content[middle : middle + 20] = bytes(20)
        path.write_bytes(content)
        blocks, error = delivered(path)
        assert re.search(r"row \d+: found broken Parquet data", error)
        found = joined(blocks)
        assert 60 < len(found) <= 120
        np.testing.assert_array_equal(found.time_s, true.time_s[: len(found)])
        np.testing.assert_array_equal(found.visible, true.usable[: len(found)])


@pytest.mark.parametrize("action", ["read", "write"])
def test_parquet_without_pyarrow_says_what_to_install(tmp_path, monkeypatch, action):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    path = store(tmp_path, "PAR1", "log.parquet")
    use, arguments = {"read": (read_log, (path, SCENE)), "write": (write_log, (path, episode()))}[
        action
    ]
    with pytest.raises(LogError, match=r'pip install "mmwave-loc\[data\]"'):
        use(*arguments)


MEMORY = """
import resource, sys
from pathlib import Path
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.models.scene import SCENES
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
rows = [block.rows for block in read_log(Path(sys.argv[1]), SCENES["street"])][-1]
print(rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no resource module")
@pytest.mark.slow
def test_a_long_log_takes_little_memory(tmp_path):
    path = tmp_path / "log.csv"
    lines = [
        line.split(",", 1)[1] for line in log_text(log_columns(episode(epochs=1))).splitlines()
    ]
    with path.open("w") as file:
        file.write(f"time_s,{lines[0]}\n")
        for t in range(300_000):
            file.writelines(f"{t},{line}\n" for line in lines[1:])
    done = subprocess.run([sys.executable, "-c", MEMORY, path], capture_output=True, text=True)
    rows, kilobytes = map(int, done.stdout.split())
    assert rows == 900_000
    assert kilobytes < 60_000  # the numbers alone would take more
