"""Helpers that make, write, read and compare small logs."""

import gzip
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest

from mmwave_env.datasets.log_folder import log_columns, log_text, path_columns
from mmwave_env.logs.live_log import LiveLog, log_from
from mmwave_env.logs.log import Log, read_log
from mmwave_env.logs.log_tables import LogError, header_of
from mmwave_env.models.scene import SCENES
from tests.filters.tracks import assert_same_fields, drawn
from tests.refusals import refuses

SCENE = SCENES["street"]
L = 3  # number of anchors
HEADER = "time_s,anchor,toa_s,aoa_azimuth_rad,aoa_elevation_rad,aod_azimuth_rad,doppler_hz,snr_db"
COLUMNS = HEADER.split(",")
SUFFIXES = (".csv", ".csv.gz", ".parquet")

# as refuses, for errors of logs
refuses_log = partial(refuses, error=LogError)


def rows(epochs=4):
    """Return the rows of a log, one dict (column -> cell) for each epoch and anchor."""
    lines = (
        f"{t},{a},{t + a}e-7,0.{a}{t},-0.{a},{a - 2}.{t},{t + 0.5 if a == 1 else ''},{20 + a}"
        for t in range(epochs)
        for a in range(1, L + 1)
    )
    return [dict(zip(COLUMNS, line.split(","), strict=True)) for line in lines]


def text(lines):
    """Return rows of a log as CSV; the columns of the first row are the header."""
    return "\n".join([",".join(lines[0]), *(",".join(line.values()) for line in lines)]) + "\n"


def in_body(content):
    """Return a log's text with angles of departure in degrees, relative to the user's heading."""
    return content.replace("aod_azimuth_rad", "aod_azimuth_body_deg")


def store(folder, content, name="log.csv"):
    """Write a log, given as rows, as text or as bytes; return its path."""
    path = folder / name
    content = text(content) if isinstance(content, list) else content
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(path, scene=SCENE, **options):
    return read_log(path, scene, **options)


def read_back(folder, content, name="log.csv", **options):
    """Write a log as :func:`store` does, and read it."""
    return read(store(folder, content, name), **options)


def read_live(content):
    """Read the text of a log line by line, as live rows; return the log and its warnings."""
    header, *lines = map(str.rstrip, content.removeprefix("\ufeff").rstrip().split("\n"))
    names, delimiter = header_of(header, "header")
    live = LiveLog(names, SCENE, delimiter=delimiter)
    epochs = [epoch for n, line in enumerate(lines, start=2) for epoch in live.add(line, n)]
    return log_from([*epochs, *live.end_epoch()]), live.warnings


def log_with(layout, time_s, measurement, visible, snr_db=20.0):
    """Return a log with these values; each group (such as a link) is visible or incomplete."""
    T = len(time_s)
    return Log(
        layout=layout,
        time_s=time_s,
        measurement=measurement,
        sigma=np.full(measurement.shape, np.nan),
        visible=visible,
        incomplete=~visible,
        doppler_anchor=np.zeros(T, int),
        snr_db=np.full((T, layout.anchors), snr_db),
        doppler_spread_hz=np.zeros(T),
        line=np.arange(T) + 2,
        restarts=np.zeros(T, bool),
    )


def damaged(log):
    """Return a log after which a line is damaged."""
    return replace(log, damage=LogError("log.csv, line 7: found 'x'"))


def delivered(path, *fields, reader=read_log):
    """Read a damaged log, whose error must name file and fields; return the epochs before it."""
    log = None
    with refuses_log(path, *fields):
        log = reader(path, SCENE)
        if log.damage:
            raise log.damage
    return log


def assert_same(log, expected, *ignored):
    """Check that all arrays of two logs or tracks are equal, but those with ``ignored`` names."""
    assert_same_fields(log, expected, *expected.arrays().keys() - {*ignored})


def shown(block):
    """Return a mask (T, rows) of the visible rows."""
    return np.repeat(block.visible, block.layout.widths, axis=1)


@lru_cache
def episode(seed=0, epochs=25, odometry=False):
    return drawn(seed, epochs=epochs, odometry=odometry)


def require_pyarrow(suffix):
    """Skip the test if it needs pyarrow and pyarrow is not installed."""
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")


def hide_anchors(path, episode, false_paths=0.0, seed=0, without=()):
    """Write an episode as a log of paths, with ``false_paths`` per epoch on average.

    ``without`` names columns that the log lacks.
    """
    columns = path_columns(episode, false_paths, np.random.default_rng(seed))
    for name in without:
        del columns[name]
    path.write_text(log_text(columns))


def write_log(path, episode):
    """Write the log of an episode as CSV, gzipped CSV or Parquet, as the name of the file says."""
    columns = log_columns(episode)
    if path.suffix == ".parquet":
        import pyarrow
        from pyarrow import parquet

        arrays = {name: pyarrow.array(v, mask=np.isnan(v)) for name, v in columns.items()}
        parquet.write_table(pyarrow.table(arrays), path, write_page_checksum=True)
        return
    content = log_text(columns).encode()
    path.write_bytes(gzip.compress(content, mtime=0) if path.suffix == ".gz" else content)
