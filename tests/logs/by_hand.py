"""Helpers that make, read and localize small logs, and that cut and compare blocks of epochs."""

from functools import lru_cache

import numpy as np
import pytest

from mmwave_env.datasets.log_writer import log_columns, log_text
from mmwave_env.localization.localizer import TrackBlock, localize
from mmwave_env.logs.log import LogBlock, read_log
from mmwave_env.logs.log_tables import LogError
from mmwave_env.models.radio import RADIOS
from mmwave_env.models.scene import SCENES
from mmwave_env.world.simulated import SimulatedSource
from tests.refusals import refuses

SCENE = SCENES["street"]
L = 3  # number of anchors
HEADER = "time_s,anchor,toa_s,aoa_azimuth_rad,aoa_elevation_rad,aod_azimuth_rad,doppler_hz,snr_db"
COLUMNS = HEADER.split(",")
SUFFIXES = (".csv", ".csv.gz", ".parquet")


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
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(path, scene=SCENE, **options):
    return LogBlock.joined(list(read_log(path, scene, **options)))


def block_of(layout, time_s, measurement, visible, snr_db=20.0):
    """Return a block with these values; each group (such as a link) is visible or incomplete."""
    T = len(time_s)
    return LogBlock(
        layout=layout,
        time_s=time_s,
        measurement=measurement,
        sigma=np.full(measurement.shape, np.nan),
        visible=visible,
        incomplete=~visible,
        doppler_anchor=np.zeros(T, int),
        snr_db=np.full((T, layout.anchors), snr_db),
        doppler_spread_hz=np.zeros(T),
        restarts=np.zeros(T, bool),
        share=1.0,
    )


def cut(block, sizes):
    """Cut a block into blocks of these sizes, which are repeated until the block ends."""
    blocks = []
    first = 0
    while first < len(block):
        size = sizes[len(blocks) % len(sizes)]
        blocks.append(block.part(slice(first, first + size)))
        first += size
    return blocks


def track_of(blocks, scene, radio, switching, **options):
    """Localize a log and return its track in one block; ``options`` are passed to ``localize``."""
    return TrackBlock.joined(list(localize(blocks, scene, radio, switching, **options)))


def damaged(epochs):
    """Yield the epochs or blocks of a log, then raise the error of a damaged line."""
    yield from epochs
    raise LogError("log.csv, line 7: found 'x'")


def delivered(path, *fields, reader=read_log, **options):
    """Read a damaged log; return the blocks before the error, which must name file and fields."""
    blocks = []
    with refuses(path, *fields, error=LogError):
        blocks.extend(reader(path, SCENE, **options))  # list() would lose all blocks
    return blocks


def assert_same(block, expected):
    """Check that all arrays of two blocks are equal."""
    for name in expected.arrays():
        np.testing.assert_array_equal(getattr(block, name), getattr(expected, name), err_msg=name)


def shown(block):
    """Return a mask (T, rows) of the visible rows."""
    return np.repeat(block.visible, block.layout.widths, axis=1)


@lru_cache
def episode(seed=0, epochs=25, odometry=False):
    source = SimulatedSource(SCENE, RADIOS["handset"], "mixed", epochs=epochs, odometry=odometry)
    return source.sample(np.random.default_rng(seed))


def require_pyarrow(suffix):
    """Skip the test if it needs pyarrow and pyarrow is not installed."""
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")


def hide_anchors(path, episode, false_paths=0, seed=0):
    """Write an episode as a log of paths in random order; add ``false_paths`` to every epoch."""
    columns = log_columns(episode)
    rng = np.random.default_rng(seed)
    del columns["anchor"]
    n = false_paths * len(episode)
    false = {name: np.full(n, np.nan) for name in columns}
    false["time_s"] = np.repeat(episode.time_s, false_paths)
    for name in COLUMNS[2:]:
        false[name] = rng.uniform(np.nanmin(columns[name]), np.nanmax(columns[name]), n)
    columns = {name: np.concatenate([values, false[name]]) for name, values in columns.items()}
    order = np.lexsort([rng.random(len(columns["time_s"])), columns["time_s"]])
    path.write_text(log_text({name: values[order] for name, values in columns.items()}))
