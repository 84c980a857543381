"""Measurement logs: what is refused where, and what was before it is delivered."""

import gzip
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mmwave_env.datasets.log_writer import log_columns, log_text, write_log
from mmwave_env.logs.log import read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.measurement import SPEED_OF_LIGHT
from tests.logs.by_hand import (
    ANCHOR,
    AOA,
    AOD,
    BODY,
    DOPPLER,
    ELEVATION,
    HEADER,
    PER_EPOCH,
    SCENE,
    SNR,
    SUFFIXES,
    TIME,
    TOA,
    L,
    delivered,
    episode,
    joined,
    read,
    require_pyarrow,
    rows,
    shown,
    store,
    text,
)

# --- what is refused


def edit(row, column, value):
    """Change one cell; rows count from 0, so row r is line r + 2."""

    def change(lines):
        lines[row][column] = value

    return change


DAMAGE = {  # change, message, epochs delivered
    "quotes": (edit(7, SNR, '"1"'), "line 9, column 'snr_db': found '\"1\"'", 2),
    "underscore": (edit(7, SNR, "1_0"), "line 9, column 'snr_db': found '1_0'", 2),
    "not UTF-8": (edit(7, AOD, "1\udcff"), r"line 9, column 'aod_azimuth_rad': .*xff", 2),
    "no time": (edit(7, TIME, ""), "line 9, column 'time_s': found nothing.*every row", 2),
    "infinite time again": (edit(6, TIME, "inf"), "line 8, column 'time_s': found inf", 2),
    "time back": (edit(7, TIME, "1"), "line 9, column 'time_s': found 1 after 2.*increase", 2),
    "second row": (edit(1, TIME, "-1"), "line 3, column 'time_s': found -1 after 0", 0),
    "no anchor": (edit(7, ANCHOR, ""), "line 9, column 'anchor': found nothing.*1 to 3", 2),
    "anchor 0": (edit(7, ANCHOR, "0"), "line 9, column 'anchor': found 0, .*1 to 3", 2),
    "anchor 4": (edit(7, ANCHOR, "4"), "line 9, column 'anchor': found 4, .*1 to 3", 2),
    "anchor 1.5": (edit(7, ANCHOR, "1.5"), "line 9, column 'anchor': found 1.5,", 2),
    "same anchor": (edit(8, ANCHOR, "2"), "line 10, column 'anchor': found 2 a second time", 2),
    "negative toa": (edit(7, TOA, "-1e-9"), "line 9, column 'toa_s': found -1e-09.*at least 0", 2),
    "zenith angle": (edit(7, ELEVATION, "1.67"), "line 9.*'aoa_elevation_rad': found 1.67", 2),
    "degrees": (edit(7, AOD, "-57.3"), "line 9.*'aod_azimuth_rad': found -57.3, which is", 2),
    "no user's shift": (edit(6, DOPPLER, "1e308"), "line 8.*'doppler_hz': found 1e.308", 2),
    "SNR of no receiver": (edit(7, SNR, "-1e4"), "'snr_db': found -10000.*-1000 to 1000 dB", 2),
    "a moment later": (edit(6, TIME, "1.0000000001"), "line 8, column 'time_s': found 1e-10 s", 2),
    "doppler of anchor 2": (edit(7, DOPPLER, "3"), "line 9, column 'doppler_hz': found 3.*1", 2),
    "one cell": (lambda lines: lines.insert(7, ["xyz"]), "line 9: found one cell, 'xyz'", 2),
    "NULs": (lambda lines: lines.insert(9, ["\0" * 90]), "line 11: found one cell.*x00", 3),
    "row too many": (lambda lines: lines.append(list(lines[9])), "line 14.*a second time", 3),
    "first of two": (lambda lines: (edit(7, TOA, "-1")(lines), edit(10, SNR, "x")(lines)),
                     "line 9, column 'toa_s'", 2),
    "text before": (lambda lines: (edit(7, SNR, "x")(lines), edit(10, TOA, "-1")(lines)),
                    "line 9, column 'snr_db'", 2),
}  # fmt: skip


@pytest.mark.parametrize(("size", "table_bytes"), [(1, 100), (2, 150), (2, 190), (1000, 1 << 20)])
@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_row_is_named_and_what_came_before_delivered(
    tmp_path, monkeypatch, name, size, table_bytes
):
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", table_bytes)
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


@pytest.mark.parametrize(
    ("column", "cells", "message"),
    [
        ("doppler_spread_hz", ["1", "2", ""], "line 3.*'doppler_spread_hz': found 2 beside 1 at"),
        ("doppler_spread_hz", ["", "-1", ""], "line 3.*'doppler_spread_hz': found -1.*at least 0"),
        ("doppler_spread_hz", ["", "1e6", ""], "line 3.*found 1000000, .* to 100000 Hz"),
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
    "no unit": (HEADER.replace("toa_s", "toa"), "column 'toa'.*toa_s, toa_ms, .* or range_m"),
    "twice": (HEADER + ",range_m", "found both 'toa_s' and 'range_m', expected toa once"),
    "the same twice": (HEADER + ",toa_s", "found 'toa_s' twice, expected toa once"),
    "speed alone": (HEADER + ",speed_mps", "found 'speed_mps' alone, expected heading.*_rad"),
    "endless name": ("a" * 200_000 + "," + HEADER, "line 1: found 'aaa.*names of columns"),
    "heading alone": (HEADER + ",heading_deg", "found 'heading_deg' alone, expected speed"),
    "body without heading": (BODY, "found no heading in .*expected heading_rad or heading_deg"),
    "arrivals twice": (HEADER + ",aoa_azimuth_station_deg", "found both 'aoa_azimuth_rad' and"),
    "two frames": (HEADER + ",aod_azimuth_body_deg,heading_deg", "found both 'aod_azimuth_rad' a"),
    "not UTF-8": (b"time_s,\xff\xfe", r"column '.*xff.*xfe': found no quantity"),
} | {
    f"no {name}": (",".join(c for c in HEADER.split(",") if c != name), f"found no .*{name}")
    for name in HEADER.split(",")
    if name != "doppler_hz"
}


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_is_refused_at_once(tmp_path, name):
    content, message = HEADERS[name]
    path = store(tmp_path, content)
    with pytest.raises(LogError) as error:
        read_log(path, SCENE)
    assert str(error.value).startswith(str(path)) and re.search(message, str(error.value))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER, "found a header and no rows, expected at least one measurement"),
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
def test_files_that_are_not_there_or_not_what_their_name_says(tmp_path, suffix):
    require_pyarrow(suffix)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_log(tmp_path / f"nowhere{suffix}", SCENE)
    with pytest.raises(LogError, match="log.* found (broken gzip|no readable Parquet|an empty)"):
        list(read_log(store(tmp_path, "" if suffix == ".csv" else "plain", f"log{suffix}"), SCENE))


def test_blocks_hold_at_least_an_epoch(tmp_path):
    with pytest.raises(ValueError, match="epochs_per_block: found 0, expected at least 1"):
        read_log(store(tmp_path, text(rows())), SCENE, epochs_per_block=0)


# --- broken files


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
    with pytest.raises(LogError, match=r'pip install "mmwave-loc\[data\]"'):
        read_log(path, SCENE) if action == "read" else write_log(path, episode())
