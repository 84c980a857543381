"""Floating-car data: the same trips from every format, and what is refused."""

import gzip
import re
from pathlib import Path

import numpy as np
import pytest

from mmwave_env.episodes.fcd import is_fcd, read_fcd

HERE = Path(__file__).parent
XML = gzip.decompress((HERE / "traffic.xml.gz").read_bytes()).decode()
CSV = gzip.decompress((HERE / "traffic.csv.gz").read_bytes()).decode()
HEADER, *ROWS = CSV.splitlines()


def everybody(name, kind):
    return True


def store(path, text):
    data = text if isinstance(text, bytes) else text.encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def assert_same(one, other):
    assert [trip[:2] for trip in one] == [trip[:2] for trip in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.time_s, b.time_s)
        np.testing.assert_array_equal(a.position_m, b.position_m)


def plain():
    """The CSV file, read by hand: id, type -> rows."""
    trips = {}
    for row in ROWS:
        time, name, x, y, _, kind, _ = row.split(";")
        trips.setdefault((name, kind), []).append((float(time), float(x), float(y)))
    return trips


@pytest.mark.parametrize("name", ["traffic.xml.gz", "traffic.csv.gz", "traffic.parquet"])
def test_trips_are_those_of_the_file_to_the_last_bit(name):
    """The three files were written by SUMO; in Parquet it rounds no positions."""
    if name.endswith(".parquet"):
        pytest.importorskip("pyarrow")
    assert is_fcd(HERE / name)
    trips = read_fcd(HERE / name, everybody)
    expected = plain()
    assert [trip[:2] for trip in trips] == list(expected) and len(trips) == 16
    for trip, rows in zip(trips, expected.values(), strict=True):
        np.testing.assert_array_equal(np.column_stack([trip.time_s, trip.position_m]), rows)


@pytest.mark.parametrize("block_bytes", [300, 5000])
@pytest.mark.parametrize("name", ["traffic.xml", "traffic.xml.gz", "traffic.csv", "traffic.csv.gz"])
def test_a_file_is_read_a_part_at_a_time(tmp_path, monkeypatch, name, block_bytes):
    monkeypatch.setattr("mmwave_env.logs.lines._BLOCK_BYTES", block_bytes)
    path = store(tmp_path / name, XML if ".xml" in name else CSV)
    assert_same(read_fcd(path, everybody), read_fcd(HERE / "traffic.csv.gz", everybody))


def test_only_trips_that_are_wanted_are_kept():
    trips = read_fcd(HERE / "traffic.xml.gz", lambda name, kind: kind == "DEFAULT_PEDTYPE")
    assert trips and {trip.kind for trip in trips} == {"DEFAULT_PEDTYPE"}
    assert all(trip.name.startswith("pedestrian") for trip in trips)


def test_rows_of_a_trip_are_lines_of_its_file():
    lines = XML.splitlines()
    for trip in read_fcd(HERE / "traffic.xml.gz", everybody):
        assert all(f'id="{trip.name}"' in lines[row - 1] for row in trip.rows)


@pytest.mark.parametrize(
    ("header", "divider"),
    [
        ("timestep_time,vehicle_id,vehicle_x,vehicle_y,a,vehicle_type,b", ","),
        ("time\tid\tx\ty\ta\ttype\tb", "\t"),
    ],
)
def test_columns_may_be_divided_and_called_otherwise(tmp_path, header, divider):
    rows = []
    for row in ROWS:
        t, name, x, y, angle, kind, speed = row.split(";")
        rows.append(divider.join([t, name, x, y, angle, kind, speed]))
    path = store(tmp_path / "a.csv", "\n".join([header, *rows]))
    assert is_fcd(path)
    assert_same(read_fcd(path, everybody), read_fcd(HERE / "traffic.csv.gz", everybody))


def test_a_csv_of_a_way_is_not_traffic(tmp_path):
    assert not is_fcd(store(tmp_path / "way.csv", "t,x,y,z\n0,1,2,3\n"))
    assert not is_fcd(tmp_path / "none.csv") and is_fcd(tmp_path / "none.xml")


# --- what is refused

HEAD = '<fcd-export><timestep time="1.00">'
BOMB = "".join(
    ["<!DOCTYPE a [", '<!ENTITY e0 "eeeeeeeeee">']
    + [f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(9)]
    + ["]><fcd-export>&e9;</fcd-export>"]
)
OUTSIDE = '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><fcd-export>&x;</fcd-export>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (XML[: len(XML) // 2], r"line \d+: found broken XML \(.*expected a file that is whole"),
        ("", r"line 1: found broken XML \(no element found"),
        ("not XML", r"line 1: found broken XML"),
        (f'{HEAD}\n<vehicle id="a" x="1" type="t"/>', "line 2, y of 'a': found None, expec"),
        (f'{HEAD}\n<vehicle id="a" x="1" y="b"/>', "line 2, y of 'a': found 'b', expected a num"),
        (f'{HEAD}\n<person id="a" x="nan" y="1"/>', "line 2, x of 'a': found 'nan', expected"),
        (f'{HEAD}\n<vehicle x="1" y="2"/>', "line 2: found no id, expected an id"),
        ('<fcd-export><timestep><vehicle id="a" x="1" y="2"/>', "time of 'a': found None"),
        (f'{HEAD}<person id="a" x="1" y="2"/>\n<person id="a" x="1" y="2"/>',
         "line 2, time: found 1, expected more than 1, that of 'a' before"),
        (BOMB, "line 1: found a document type, expected none"),
        (OUTSIDE, "line 1: found a document type, expected none"),
        (HEAD + '<vehicle id="' + "x\n" * 3_000_000, "found a tag of more than 4194304 characters"),
        ("<a>" + "x" * 3_000_000, "line 1: found more than 1048576 bytes"),
    ],
    ids=["half", "empty", "words", "no y", "y", "nan", "no id", "no time", "twice", "bomb",
         "outside", "tag", "line"],
)  # fmt: skip
@pytest.mark.parametrize("name", ["a.xml", "a.xml.gz"])
def test_broken_xml_is_refused_by_its_line(tmp_path, name, text, message):
    path = store(tmp_path / name, text)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}.*{message}"):
        read_fcd(path, everybody)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{HEADER}\n1.0;a;1.0", "line 2: found 3 values, expected 7"),
        (f"{HEADER}\n{ROWS[0]}\n2;a;1;far;0;t;0", "line 3, y of 'a': found 'far', expected a num"),
        (f"{HEADER}\n;a;1;2;0;t;0", "line 2, time of 'a': found '', expected a number"),
        (f"{HEADER}\n1;;1;2;0;t;0", "line 2: found no id"),
        (f"{HEADER}\n2;a;1;2;0;t;0\n1;a;1;2;0;t;0", "line 3, time: found 1, expected more than 2"),
        ("timestep_time;vehicle_id;lon\n1;2;3", "header: found .*expected columns for x, y, too"),
    ],
)
def test_broken_csv_is_refused_by_its_line(tmp_path, text, message):
    path = store(tmp_path / "a.csv.gz", text)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}.*{message}"):
        read_fcd(path, everybody)


def test_gzip_that_ends_too_early_is_no_shorter_traffic(tmp_path):
    path = tmp_path / "a.csv.gz"
    path.write_bytes((HERE / "traffic.csv.gz").read_bytes()[:-200])
    with pytest.raises(ValueError, match=r"a.csv.gz, line \d+: found broken gzip data"):
        read_fcd(path, everybody)


def test_broken_parquet_is_refused(tmp_path):
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "a.parquet"
    content = (HERE / "traffic.parquet").read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match=r"a.parquet: found no readable Parquet"):
        read_fcd(path, everybody)
    parquet.write_table(arrow.table({"time": [1.0], "id": ["a"], "x": [2.0]}), path)
    with pytest.raises(ValueError, match="a.parquet: header: .*expected columns for y, too"):
        read_fcd(path, everybody)
    parquet.write_table(arrow.table({"time": [1.0], "id": ["a"], "x": [2.0], "y": [None]}), path)
    with pytest.raises(ValueError, match="a.parquet: row 1, y of 'a': found None"):
        read_fcd(path, everybody)


def test_other_files_are_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match="none.xml: found no such file"):
        read_fcd(tmp_path / "none.xml", everybody)
    with pytest.raises(ValueError, match=r"a.txt: name: found '.txt', expected one that ends in"):
        read_fcd(store(tmp_path / "a.txt", "x"), everybody)
