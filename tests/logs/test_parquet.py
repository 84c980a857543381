"""Tests of logs in Parquet: types of columns, and damage."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmwave_env.logs.log_tables import LogError
from tests.logs.by_hand import (
    COLUMNS,
    L,
    assert_same,
    delivered,
    episode,
    read,
    refuses_log,
    rows,
    write_log,
)

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")


def columns_of(**changes):
    """Return the columns of a log by name, some of them changed; None is a missing value."""
    known = {name: [float(row[name]) if row[name] else None for row in rows()] for name in COLUMNS}
    return known | changes


def stored(folder, columns):
    path = folder / "log.parquet"
    parquet.write_table(pyarrow.table(columns), path)
    return path


@pytest.mark.parametrize("unit", ["s", "ns"])
def test_dates_are_read(tmp_path, unit):
    time = np.datetime64(1_790_000_000, "s") + np.arange(12) // L
    time = pyarrow.array(time.astype(f"datetime64[{unit}]"))
    log = read(stored(tmp_path, columns_of(time_s=time)))
    assert_array_equal(log.time_s, 1.79e9 + np.arange(4))


@pytest.mark.parametrize("kind", ["int8", "int64", "float32", "decimal"])
def test_columns_of_any_numeric_type_are_read(tmp_path, kind):
    kind = pyarrow.decimal128(30, 1) if kind == "decimal" else getattr(pyarrow, kind)()
    anchor = pyarrow.array([1, 2, 3] * 4).cast(kind)
    empty = pyarrow.nulls(12)
    block = read(stored(tmp_path, columns_of(anchor=anchor, doppler_hz=empty)))
    assert block.visible[:, :L].all() and not block.visible[:, L].any()


def test_an_index_of_pandas_is_ignored(tmp_path):
    columns = columns_of()
    table = pyarrow.table(columns | {"__index_level_0__": range(12)})
    pandas = {"pandas": '{"index_columns": ["__index_level_0__", "time_s", {}]}'}
    path = stored(tmp_path, columns)
    expected = read(path)
    parquet.write_table(table.replace_schema_metadata(pandas), path)
    assert_same(read(path), expected)


def test_a_column_that_occurs_twice_is_refused(tmp_path):
    table = pyarrow.table(columns_of())
    path = tmp_path / "log.parquet"
    parquet.write_table(table.append_column("snr_db", table["snr_db"]), path)
    with pytest.raises(LogError, match="columns: found 'snr_db' twice"):
        read(path)


@pytest.mark.parametrize("values", [["1"] * 12, [True] * 12, [[1.0]] * 12])
def test_columns_that_are_not_numeric_are_refused(tmp_path, values):
    with refuses_log("column 'snr_db'"):
        read(stored(tmp_path, columns_of(snr_db=values)))


@pytest.mark.parametrize(
    ("column", "row", "value"),
    [
        ("anchor", 7, 9.0),
        ("anchor", 7, None),
        ("time_s", 7, 0.0),
        ("time_s", 6, None),
        ("doppler_hz", 4, 1.0),
    ],
)
def test_the_epochs_before_a_damaged_row_are_returned_before_the_error(
    tmp_path, column, row, value
):
    columns = columns_of()
    columns[column][row] = value
    log = delivered(stored(tmp_path, columns), f"row {row + 1}", column)
    assert (0 if log is None else len(log)) == row // L


def test_column_names_that_are_not_valid_text_are_refused(tmp_path):
    path = stored(tmp_path, columns_of(odd_note=[1.0] * len(rows())))
    path.write_bytes(path.read_bytes().replace(b"odd_note", b"odd\xffnote"))
    with refuses_log("log.parquet"):
        read(path)


def test_a_file_with_a_broken_page_is_refused(tmp_path):
    path = tmp_path / "log.parquet"
    write_log(path, episode(epochs=200))
    plain = {"compression": "none", "use_dictionary": False}
    parquet.write_table(parquet.read_table(path), path, write_page_checksum=True, **plain)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 20] = bytes(20)
    path.write_bytes(content)
    with refuses_log("log.parquet"):
        read(path)
