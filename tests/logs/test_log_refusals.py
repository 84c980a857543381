"""Tests of damaged logs: the epochs before the damage are read, then an error names the damage."""

import sys
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmwave_env.io.lookup import MissingExtraError
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from tests.logs.by_hand import (
    COLUMNS,
    HEADER,
    SUFFIXES,
    L,
    assert_same,
    delivered,
    episode,
    in_body,
    read,
    read_back,
    read_live,
    refuses_log,
    require_pyarrow,
    rows,
    store,
    text,
    write_log,
)
from tests.refusals import refuses

every_suffix = pytest.mark.parametrize("suffix", SUFFIXES)


def edit(row, column, value):
    """Return a function that changes a cell in a row; row 0 is line 2, which follows the header."""
    return lambda lines: lines[row].update({column: value})


CELLS = [  # row, column and wrong content of the cell
    (7, "snr_db", '"1'),
    (7, "snr_db", '"1"5'),
    (7, "snr_db", "1_0"),
    (7, "aod_azimuth_rad", "1\udcff"),  # not UTF-8
    (7, "time_s", ""),
    (6, "time_s", "inf"),
    (7, "time_s", "1"),
    (1, "time_s", "-1"),
    (6, "time_s", "1.0000000001"),
    *((7, "anchor", number) for number in ("", "0", "4", "1.5")),
    (8, "anchor", "2"),
    (7, "doppler_hz", "3"),
]
DAMAGE = {  # name -> change, fields that the message names, number of epochs before the error
    f"line {row + 2}, {column} {value!a}": (
        edit(row, column, value),
        [f"line {row + 2}", column],
        row // L,
    )
    for row, column, value in CELLS
} | {
    "one cell": (lambda lines: lines.insert(7, {"": "xyz"}), ["line 9"], 2),
    "NULs": (lambda lines: lines.insert(9, {"": "\0" * 90}), ["line 11"], 3),
    "additional row": (
        lambda lines: lines.append(lines[9] | {"snr_db": "3"}),
        ["line 14", "anchor"],
        3,
    ),
    "first of two errors": (
        lambda lines: (lines[7].update(anchor="9"), lines[10].update(snr_db="x")),
        ["line 9", "anchor"],
        2,
    ),
    "text before a wrong number": (
        lambda lines: (lines[7].update(snr_db="x"), lines[10].update(anchor="9")),
        ["line 9", "snr_db"],
        2,
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_epochs_before_a_damaged_row_are_read_before_an_error_names_the_row(tmp_path, name):
    change, fields, epochs = DAMAGE[name]
    lines = rows()
    change(lines)
    path = store(tmp_path, text(lines).encode("utf-8", "surrogateescape"))
    log = delivered(path, *fields)
    if log is None:
        assert not epochs
    else:
        whole = read_back(tmp_path, rows(), "whole.csv")
        assert_same(replace(log, line=whole.line[:epochs]), whole.part(slice(epochs)))


LOST = {  # cells of a row -> columns whose cells are left out
    "a range far below 0": ({"toa_s": "-1e-7"}, "toa_s"),
    "an elevation beyond the vertical": ({"aoa_elevation_rad": "-1.578"}, "aoa_elevation_rad"),
    "9999": (dict.fromkeys(COLUMNS[2:6], "-9999.0"), " ".join(COLUMNS[2:6])),
    "-1 in a whole link": (dict.fromkeys(COLUMNS[2:], "-1"), " ".join(COLUMNS[2:])),
    "an infinite shift": ({"doppler_hz": "1e999"}, "doppler_hz"),
    **{
        f"a deviation of {value}": ({"range_sigma_m": value}, "range_sigma_m toa_s")
        for value in ("inf", "1e10", "1.8e308", "0", "-1")
    },
}


@pytest.mark.parametrize("name", LOST)
def test_values_that_mean_lost_or_are_impossible_are_left_out_of_files_and_live(tmp_path, name):
    cells, columns = LOST[name]
    lines = [{**line, "range_sigma_m": "0.5"} for line in rows()]
    lines[6] |= cells
    empty = deepcopy(lines)
    empty[6] |= dict.fromkeys(columns.split(), "")
    expected = read_back(tmp_path, empty, "empty.csv")
    with pytest.warns(UserWarning, match=f"left out: 1 of '{columns.split()[0]}'.*line 8"):
        log = read_back(tmp_path, lines)
    assert_same(log, expected)
    live, warnings = read_live(text(lines))
    assert_same(live, log, "line")
    assert len(warnings) == len(columns.replace(" toa_s", "").split())


def test_ranges_slightly_below_0_and_unwrapped_azimuths_are_used(tmp_path):
    lines = rows()
    lines[7] |= {"toa_s": "-1e-9", "aod_azimuth_rad": "-810"}
    content = text(lines).replace("aod_azimuth_rad", "aod_azimuth_deg")
    z = read_back(tmp_path, content).measurement[2]
    assert_allclose(z[[4, 7]], [-1e-9 * SPEED_OF_LIGHT, -np.pi / 2])


@pytest.mark.parametrize("angle", [np.pi / 2, -np.pi / 2, float(np.float32(np.pi / 2))])
def test_elevations_of_straight_up_and_down_are_accepted(tmp_path, angle):
    lines = rows()
    lines[7]["aoa_elevation_rad"] = repr(angle)
    assert read_back(tmp_path, lines).measurement[2, 6] == angle


def test_numbers_beyond_the_limits_are_kept_if_limits_are_off(tmp_path):
    lines = rows()
    lines[7].update(aoa_azimuth_rad="57.3", aoa_elevation_rad="95.7")
    lines[7].update(aod_azimuth_rad="-360.5", toa_s="1.0")
    block = read_back(tmp_path, lines, limits=False)
    assert_allclose(block.measurement[2, 4:8], [SPEED_OF_LIGHT, 57.3, 95.7, -360.5])


@pytest.mark.parametrize(
    ("column", "cells", "line"),
    [
        ("doppler_spread_hz", ["1", "2", ""], 3),
        ("doppler_spread_hz", ["", "-2", ""], 3),
        ("doppler_spread_hz", ["", "1e6", ""], 3),
        ("speed_mps", ["", "1.5", "1.6"], 4),
        ("heading_rad", ["", "x", ""], 3),
    ],
)
def test_wrong_values_that_apply_to_a_whole_epoch_are_refused(tmp_path, column, cells, line):
    of_epochs = dict.fromkeys(("doppler_spread_hz", "speed_mps", "heading_rad"), "")
    lines = [row | of_epochs | {column: cell} for row, cell in zip(rows(1), cells, strict=True)]
    assert not delivered(store(tmp_path, lines), f"line {line}", column)


HEADERS = {  # name -> header, fields that the message names
    "empty": ("", []),
    "no columns": ("\n", ["line 1"]),
    "tabs": (HEADER.replace(",", "\t"), ["line 1"]),
    "endless name": ("a" * 200_000 + "," + HEADER, ["column 'aaa"]),
    "no header": ("0,1,1e-7,0,0,0,1,20", ["line 1"]),
    "no header, times before 0": ("-1.5,1,1e-7,0,0,0,1,20", ["line 1"]),
    "unknown": (HEADER + ",color", ["column 'color'"]),
    "users": (HEADER + ",ue", ["column 'ue'"]),
    "no unit": (HEADER.replace("toa_s", "toa"), ["column 'toa'"]),
    "not UTF-8": (b"time_s,\xff\xfe", ["column"]),
    **{  # each added column conflicts with the header, or needs another column
        f"{columns} added": (f"{HEADER},{columns}", ["columns"])
        for columns in (
            "range_m",
            "toa_s",
            "speed_mps",
            "heading_deg",
            "aoa_azimuth_station_deg",
            "aod_azimuth_body_deg,heading_deg",
        )
    },
    "body without heading": (in_body(HEADER), ["columns"]),
    **{
        f"no {name}": (",".join(column for column in COLUMNS if column != name), ["columns"])
        for name in ("time_s", "anchor", "snr_db")
    },
}


@pytest.mark.parametrize("name", HEADERS)
def test_a_wrong_header_is_refused_before_any_row_is_read(tmp_path, name):
    content, fields = HEADERS[name]
    path = store(tmp_path, content)
    with refuses_log(path, *fields):
        read(path)


@pytest.mark.parametrize("lines", [[], ["0,1,,,,,,"], [f"{t},1,1e-7,,,,," for t in range(9)]])
def test_a_log_without_any_measurement_is_refused(tmp_path, lines):
    path = store(tmp_path, "\n".join([HEADER, *lines]))
    message = f"{len(lines)} epochs without a measurement" if lines else "no rows below the header"
    with pytest.raises(LogError, match=f"found {message}"):
        read(path)


@every_suffix
def test_a_log_that_needs_more_memory_than_there_is_is_refused_with_its_size(
    tmp_path, monkeypatch, suffix
):
    require_pyarrow(suffix)
    path = tmp_path / f"log{suffix}"
    write_log(path, episode(epochs=2000))
    monkeypatch.setattr("mmwave_env.logs.lines.free_memory", lambda: 1e6)
    with pytest.raises(OSError, match=r"needs 0.01\d GB of memory, expected at most 0.001 GB"):
        read(path)


@pytest.mark.parametrize("name", ["log.txt", "log", "log.csv.zip", "log.gz"])
def test_files_with_an_unknown_ending_are_refused(tmp_path, name):
    with refuses_log(name):
        read_back(tmp_path, text(rows()), name)


@every_suffix
def test_missing_files_and_files_that_do_not_match_their_ending_are_refused(tmp_path, suffix):
    require_pyarrow(suffix)
    with refuses("nowhere", error=FileNotFoundError):
        read(tmp_path / f"nowhere{suffix}")
    with refuses_log("log"):
        read_back(tmp_path, "" if suffix == ".csv" else "plain", f"log{suffix}")


@pytest.mark.parametrize("left", [0.2, 0.5, 0.99])
def test_the_epochs_of_a_gzip_file_that_ends_early_are_returned_before_the_error(tmp_path, left):
    true = episode(epochs=2000)
    path = tmp_path / "log.csv.gz"
    write_log(path, true)
    packed = path.read_bytes()
    path.write_bytes(packed[: int(left * len(packed))])
    block = delivered(path, "line")
    assert len(block) > (left - 0.1) * 2000
    assert_array_equal(block.time_s, true.time_s[: len(block)])


@pytest.mark.parametrize("byte", [2, 3, 5000, -6])
def test_a_gzip_file_with_a_wrong_byte_is_refused(tmp_path, byte):
    path = tmp_path / "log.csv.gz"
    write_log(path, episode(epochs=2000))
    packed = bytearray(path.read_bytes())
    packed[byte] ^= 0xFF
    path.write_bytes(packed)
    delivered(path)


def test_the_epochs_before_a_line_without_an_end_are_returned_before_the_error(tmp_path):
    content = text(rows()).encode() + b"\0" * (3 << 20)
    assert len(delivered(store(tmp_path, content), "line 14")) == 4


def test_the_error_about_missing_pyarrow_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    path = store(tmp_path, "PAR1", "log.parquet")
    with pytest.raises(MissingExtraError, match=r"pip install 'mmwave-loc\[data\]'"):
        read(path)
